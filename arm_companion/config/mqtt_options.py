"""Options of the telemetry over MQTT."""

import re
from dataclasses import dataclass

from arm_companion.config.options import option
from arm_companion.errors import ConfigError

_LOOPBACK = ("localhost", "127.0.0.1", "::1")


@dataclass(frozen=True)
class MqttConfig:
    """[mqtt] Telemetry for people to a broker; off without a host."""

    host: str = option("broker; empty: no MQTT", "")
    port: int = option("of the broker; 0 is 8883 with TLS and 1883 without", 0, lower=0, upper=65_535)
    vehicle: str = option("name of this vehicle in topics: arm/NAME/...", "1")
    protocol: str = option(
        "MQTT version; auto: 5, and 3.1.1 where the broker has no 5", "auto", choices=("auto", "5", "3.1.1")
    )
    tls: bool = option("whether the connection is encrypted and the broker's certificate checked", default=False)
    ca_file: str = option("PEM of who signed the broker's certificate; empty: the system's", "")
    certificate_file: str = option("PEM of our own certificate, for brokers that ask for one; empty: none", "")
    key_file: str = option("PEM of the key of certificate_file, not readable for others", "")
    user_file: str = option("file with the user name; empty: none", "")
    password_file: str = option("file with the password, not readable for others; empty: none", "")
    state_hz: float = option("rate of state; a change is told at once", 1.0, unit="Hz", lower=0.0, upper=50.0)
    wrench_hz: float = option("rate of wrench", 2.0, unit="Hz", lower=0.0, upper=50.0)
    tendons_hz: float = option("rate of tendons", 1.0, unit="Hz", lower=0.0, upper=50.0)
    health_hz: float = option("rate of health", 0.2, unit="Hz", lower=0.0, upper=10.0)
    queue_length: int = option("messages that may wait; beyond, the oldest is dropped", 256, lower=8, upper=10_000)
    keepalive_s: int = option("a broker that is silent for this long counts as gone", 15, unit="s", lower=2, upper=3600)
    reconnect_max_s: float = option("longest pause between attempts to connect", 30.0, unit="s", lower=0.5, upper=600.0)
    commands: bool = option("whether commands are taken, on arm/NAME/command", default=False)
    command_system: int = option(
        "MAVLink system id that MQTT's commands count as, for vehicle.commanders", 254, lower=1, upper=255
    )
    command_age_s: float = option("an older command is refused", 5.0, unit="s", lower=0.2, upper=60.0)

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", self.vehicle):
            raise ConfigError(f"vehicle = {self.vehicle!r} is no name for a topic: 1 to 64 letters, digits, _ . -")
        if bool(self.certificate_file) != bool(self.key_file):
            raise ConfigError("certificate_file and key_file go together")
        if self.password_file and not self.user_file:
            raise ConfigError("password_file needs user_file")
        if (self.ca_file or self.certificate_file) and not self.tls:
            raise ConfigError("ca_file and certificate_file need tls = true")
        if self.commands and self.host not in _LOOPBACK:
            if not self.tls:
                raise ConfigError("commands over a network need tls = true")
            if not (self.password_file or self.certificate_file):
                raise ConfigError("commands over a network need a password_file or a certificate_file")

    @property
    def broker_port(self) -> int:
        """The port, filled in."""
        return self.port or (8883 if self.tls else 1883)
