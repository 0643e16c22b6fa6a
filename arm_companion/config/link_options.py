"""Options of the vehicle, of the links to it and to the ground, and of our MAVLink component."""

from collections.abc import Mapping
from dataclasses import dataclass

from arm_companion.config.options import option, options
from arm_companion.errors import ConfigError


@dataclass(frozen=True)
class VehicleConfig:
    """[vehicle] The drone that carries the arm, and its autopilot."""

    autopilot: str = option("flight stack", "px4", choices=("px4", "ardupilot"))
    mass_kg: float = option("take-off mass with the arm", 1.8, unit="kg", lower=0.1, upper=200.0)
    system_id: int = option("MAVLink system id; 0 takes the autopilot's", 0, lower=0, upper=255)
    component_id: int = option("MAVLink component id of this daemon", 192, lower=1, upper=250)
    state_rate_hz: float = option("asked rate of attitude and position", 100.0, unit="Hz", lower=1.0, upper=250.0)
    heartbeat_timeout_s: float = option("autopilot counts as gone after", 2.0, unit="s", lower=0.2, upper=30.0)
    state_timeout_s: float = option("vehicle state counts as stale after", 0.25, unit="s", lower=0.02, upper=5.0)
    commanders: tuple[int, ...] = option(
        "MAVLink system ids that may command the arm; empty allows every ground station",
        (),
        lower=1,
        upper=255,
    )


STREAMED = (
    "ARM_STATUS",
    "ARM_TENDONS",
    "ARM_REACTION_WRENCH",
    "ARM_STIFFNESS",
    "ARM_PAYLOAD",
    "NAMED_VALUE_FLOAT",
    "DEBUG_FLOAT_ARRAY",
    "LINK_NODE_STATUS",
    "ONBOARD_COMPUTER_STATUS",
)
"""Messages with a rate of their own on each link."""


@dataclass(frozen=True)
class LinkConfig:
    """[links.NAME] One MAVLink connection."""

    url: str = option(
        "udpin:HOST:PORT, udpout:HOST:PORT, udpbcast:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD"
    )
    role: str = option(
        "who is at the other end; a peer is a component on board, such as a vision process",
        "ground",
        choices=("autopilot", "ground", "peer"),
    )
    rates_hz: Mapping[str, float] = options("rate of a message on this link, instead of [rates]'s", upper=200.0)
    pace_s: float = option(
        "least time between frames; 0 is 0.005 to a PX4 autopilot and none elsewhere",
        0.0,
        unit="s",
        lower=0.0,
        upper=0.5,
    )
    bandwidth_bytes_per_s: float = option(
        "most that is sent, set-points aside; 0 is what a serial line's speed allows, else no limit",
        0.0,
        unit="B/s",
        lower=0.0,
        upper=1e8,
    )
    tunnel: str = option(
        "our own messages inside TUNNEL; auto: towards the autopilot, which forwards them in no other way",
        "auto",
        choices=("auto", "on", "off"),
    )
    mirrors: str = option(
        "the essentials as NAMED_VALUE_FLOAT and DEBUG_FLOAT_ARRAY too; auto: towards the autopilot",
        "auto",
        choices=("auto", "on", "off"),
    )
    forward: bool = option("whether frames pass between this link and the others that have this set", default=False)
    signing_key: str = option("file with the 32 bytes of the signing key, mode 0600; empty: nothing is signed", "")
    unsigned: str = option(
        "with a signing key, unsigned frames are dropped (refuse), may tell but not ask for anything (listen), or "
        "count like signed ones (accept)",
        "refuse",
        choices=("refuse", "listen", "accept"),
    )

    def __post_init__(self) -> None:
        for name in self.rates_hz:
            if name not in STREAMED:
                raise ConfigError(f"rates_hz names {name}, which is none of {', '.join(STREAMED)}")


@dataclass(frozen=True)
class MavlinkConfig:
    """[mavlink] Our component: who may ask it for what, and what it keeps."""

    state_directory: str = option(
        "where parameters and signing time stamps are kept; empty: where systemd says, else nowhere", ""
    )
    mission_commands: bool = option("whether items of the autopilot's mission may command the arm", default=True)
    grab: str = option("what DO_GRIPPER's grab means", "perch", choices=("perch", "grasp"))
    actuator: int = option(
        "value of DO_SET_ACTUATOR, 1 to 6, that bends the arm: 1.0 is limits.bend_max_rad; 0: none", 0, lower=0, upper=6
    )
    control_timeout_s: float = option(
        "a ground station loses primary control when silent for", 10.0, unit="s", lower=2.0, upper=600.0
    )
    target_age_s: float = option(
        "ARM_TARGET and ARM_SETPOINT with a stamp older than this are refused", 2.0, unit="s", lower=0.05, upper=60.0
    )
    check_vehicle: bool = option("whether the autopilot's settings are looked at after start and reboot", default=True)
    vehicle_instance: int = option(
        "n in the MAV_n_* parameters (MAVn_* on ArduPilot) of the autopilot's port to this computer; "
        "-1 is 1 on PX4 (TELEM2) and 2 on ArduPilot (SERIAL2)",
        -1,
        lower=-1,
        upper=9,
    )
