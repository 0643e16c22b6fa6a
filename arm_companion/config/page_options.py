"""Options of the page for the field."""

import ipaddress
import re
from dataclasses import dataclass

from arm_companion.config.options import option
from arm_companion.errors import ConfigError


@dataclass(frozen=True)
class PageConfig:
    """[page] A page for a browser in the field: state, tensions, wrench, drawing, ABORT; off without a host."""

    host: str = option("address to serve it at, such as 127.0.0.1; 0.0.0.0: all; empty: no page", "")
    port: int = option("TCP port", 8080, lower=1, upper=65_535)
    token_file: str = option("file with the token that the page asks for, not readable for others", "")
    names: tuple[str, ...] = option("host names by which browsers may call it; addresses and localhost always", ())
    rate_hz: float = option("rate of updates while somebody looks", 5.0, unit="Hz", lower=0.5, upper=20.0)
    abort: bool = option("whether the page has the ABORT button", default=True)
    command_system: int = option(
        "MAVLink system id that the page's ABORT counts as, for vehicle.commanders", 253, lower=1, upper=255
    )

    def __post_init__(self) -> None:
        if not self.host:
            return
        try:
            local = self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            raise ConfigError(f"host = {self.host!r} is no IP address, nor localhost") from None
        if not local and not self.token_file:
            raise ConfigError(f"host = {self.host!r} is not loopback and needs a token_file")
        for name in self.names:
            if not re.fullmatch(r"[A-Za-z0-9_.-]{1,253}", name):
                raise ConfigError(f"names: {name!r} is no host name")
