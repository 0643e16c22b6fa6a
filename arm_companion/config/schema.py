"""Every option of the system: meaning, unit, bounds and default in one place.

Keys follow the sections of the TOML files in `configs/`. SI units throughout; where a key's value is not SI,
its suffix says so.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from arm_companion.config.options import option, options, section
from arm_companion.errors import ConfigError


@dataclass(frozen=True)
class BackboneConfig:
    """[arm.backbone] The elastic rod in the arm's middle."""

    diameter_m: float = option("diameter", 0.0016, unit="m", lower=1e-4, upper=0.02)
    youngs_modulus_pa: float = option("Young's modulus", 60e9, unit="Pa", lower=1e6, upper=1e12)
    poisson_ratio: float = option("Poisson's ratio", 0.33, lower=0.0, upper=0.499)


@dataclass(frozen=True)
class ArmTendonsConfig:
    """[arm.tendons] The cables from the pulleys to the end disk."""

    angles_deg: tuple[float, ...] = option(
        "angle of each tendon about the base z axis, the paper's order",
        (0.0, -90.0, -180.0, -270.0),
        unit="deg",
    )
    diameter_m: float = option("diameter", 0.0006, unit="m", lower=1e-5, upper=0.01)
    youngs_modulus_pa: float = option("Young's modulus", 4e9, unit="Pa", lower=1e6, upper=1e12)
    routing_length_m: float = option("length between pulley and base disk", 0.1, unit="m", lower=0.0, upper=5.0)
    pretension_n: float = option("tension of the straight, unloaded arm", 4.0, unit="N", lower=0.0, upper=100.0)
    servo_stiffness_n_per_m: float = option(
        "compliance of servo and pulley in series with each tendon; inf-like values mean rigid",
        1e9,
        unit="N/m",
        lower=1.0,
        upper=1e12,
    )
    guide_friction: float = option(
        "Coulomb coefficient of the tendons in their guides; only the research commands use it, 0 is none",
        0.0,
        lower=0.0,
        upper=2.0,
    )


@dataclass(frozen=True)
class ArmMassConfig:
    """[arm.mass] What moves with the arm; the housing counts with the airframe."""

    disk_kg: float = option("each spacer disk", 0.003, unit="kg", lower=0.0, upper=1.0)
    end_disk_kg: float = option("end disk, a point mass at the tip", 0.006, unit="kg", lower=0.0, upper=1.0)
    backbone_density_kg_m3: float = option("backbone", 6450.0, unit="kg/m^3", lower=0.0, upper=30000.0)
    tendons_kg: float = option("all tendons inside the arm", 0.0005, unit="kg", lower=0.0, upper=1.0)


@dataclass(frozen=True)
class ArmConfig:
    """[arm] Geometry and material of the continuum arm (one segment)."""

    length_m: float = option("backbone length, base disk to end disk", 0.25, unit="m", lower=0.02, upper=3.0)
    pitch_radius_m: float = option("radius of the tendons' pitch circle", 0.02, unit="m", lower=1e-3, upper=0.2)
    disks: int = option("disks without the base disk, end disk included", 10, lower=2, upper=200)
    pulley_radius_m: float = option("radius at which a tendon winds", 0.01, unit="m", lower=1e-3, upper=0.1)
    backbone: BackboneConfig = section(BackboneConfig)
    tendons: ArmTendonsConfig = section(ArmTendonsConfig)
    mass: ArmMassConfig = section(ArmMassConfig)

    def __post_init__(self) -> None:
        if len(self.tendons.angles_deg) < 3:  # fewer cannot pull every way
            raise ConfigError(f"tendons.angles_deg has {len(self.tendons.angles_deg)} entries; at least 3 are needed")


@dataclass(frozen=True)
class MountConfig:
    """[mount] Where the arm sits on the airframe."""

    position_m: tuple[float, ...] = option(
        "arm base from the airframe's centre of mass, body axes (FRD)",
        (0.0, 0.0, 0.12),
        unit="m",
        lower=-2.0,
        upper=2.0,
        length=3,
    )
    rpy_deg: tuple[float, ...] = option(
        "roll, pitch, yaw that turn body axes into base axes; zero is an arm below, z down",
        (0.0, 0.0, 0.0),
        unit="deg",
        lower=-180.0,
        upper=180.0,
        length=3,
    )


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


@dataclass(frozen=True)
class ServosConfig:
    """[servos] The Dynamixel bus and what each servo pulls."""

    port: str = option("serial device of the bus, or tcp:HOST:PORT of a bridge to it", "/dev/ttyUSB0")
    baud: int = option("bits per second", 1_000_000, lower=9600, upper=4_500_000)
    ids: tuple[int, ...] = option("servo id of each tendon, in the tendons' order", (1, 2, 3, 4), lower=0, upper=252)
    directions: tuple[int, ...] = option(
        "+1 where a growing position takes tendon in, -1 where it lets out", (1, 1, 1, 1), lower=-1, upper=1
    )
    zero_ticks: tuple[int, ...] = option(
        "position at which each tendon holds the straight arm at its pretension",
        (2048, 2048, 2048, 2048),
        lower=-1_048_575,
        upper=1_048_575,
    )
    reply_timeout_s: float = option("deadline of one bus transaction", 0.008, unit="s", lower=0.001, upper=0.5)
    watchdog_s: float = option("servos stop when the bus is silent for", 0.2, unit="s", lower=0.02, upper=2.54)
    silent_after: int = option("missed replies in a row until a servo counts as silent", 10, lower=1, upper=1000)
    load_torque_nm: float = option("torque at 100 % load", 1.4, unit="N m", lower=0.05, upper=50.0)
    load_sigma: float = option("one sigma of the load reading, share of full load", 0.02, lower=0.0, upper=1.0)
    friction_torque_nm: float = option("torque lost in the gear train", 0.05, unit="N m", lower=0.0, upper=5.0)

    def __post_init__(self) -> None:
        n = len(self.ids)
        if len(set(self.ids)) != n:
            raise ConfigError(f"ids = {list(self.ids)} names a servo twice")
        for name in ("directions", "zero_ticks"):
            if len(getattr(self, name)) != n:
                raise ConfigError(f"{name} has {len(getattr(self, name))} entries for {n} ids")
        if any(d == 0 for d in self.directions):
            raise ConfigError("directions must be +1 or -1")


@dataclass(frozen=True)
class LimitsConfig:
    """[limits] What no command that leaves may exceed."""

    tension_min_n: float = option("least tension of every tendon", 0.5, unit="N", lower=0.0, upper=50.0)
    tension_max_n: float = option("greatest tension of any tendon", 45.0, unit="N", lower=1.0, upper=500.0)
    pull_max_m: float = option("tendon taken in or let out, from straight", 0.12, unit="m", lower=0.001, upper=2.0)
    pull_speed_m_per_s: float = option("tendon speed", 0.05, unit="m/s", lower=0.001, upper=1.0)
    bend_max_rad: float = option("commanded bend of the free arm", 5.1, unit="rad", lower=0.1, upper=4 * math.pi)
    wrench_force_n: float = option("predicted force on the airframe", 12.0, unit="N", lower=0.1, upper=500.0)
    wrench_moment_nm: float = option("predicted moment on the airframe", 2.5, unit="N m", lower=0.01, upper=200.0)
    vehicle_speed_m_per_s: float = option("set-point speed near the bar", 0.3, unit="m/s", lower=0.01, upper=5.0)
    feedforward_m_per_s2: float = option("acceleration feed-forward", 3.5, unit="m/s^2", lower=0.0, upper=8.0)


@dataclass(frozen=True)
class PerchConfig:
    """[perch] The anchor perch: an arm below wraps a bar, the vehicle flies on."""

    bar_position_m: tuple[float, ...] = option(
        "point on the bar's axis, world NED from the autopilot's origin, until a target message replaces it",
        (3.0, 0.0, -2.0),
        unit="m",
        lower=-10_000.0,
        upper=10_000.0,
        length=3,
    )
    bar_axis_deg: float = option(
        "heading of the bar's axis, clockwise from north", 90.0, unit="deg", lower=-180.0, upper=180.0
    )
    bar_radius_m: float = option("radius of the bar", 0.035, unit="m", lower=0.002, upper=0.5)
    contact_arc_m: float = option("arc length at which the arm meets the bar", 0.06, unit="m", lower=0.01, upper=3.0)
    disk_radius_m: float = option("outer radius of the disks", 0.023, unit="m", lower=0.001, upper=0.3)
    standoff_m: float = option(
        "horizontal distance from the bar at which the approach ends", 0.6, unit="m", lower=0.05, upper=5.0
    )
    approach_speed_m_per_s: float = option("towards the stand-off", 0.5, unit="m/s", lower=0.02, upper=3.0)
    reach_speed_m_per_s: float = option("towards the bar", 0.04, unit="m/s", lower=0.01, upper=0.5)
    overreach_m: float = option(
        "how far past the expected contact to look for the bar", 0.06, unit="m", lower=0.0, upper=0.5
    )
    contact_force_n: float = option(
        "horizontal force on the vehicle, beyond the free arm's, that means contact",
        0.35,
        unit="N",
        lower=0.05,
        upper=20.0,
    )
    wrap_bend_rad: float = option("commanded bend of the full wrap", 4.9, unit="rad", lower=0.5, upper=12.0)
    free_arc_m: float = option(
        "effective arc length between base and bar of the wrapped arm, which acts as a spring",
        0.08,
        unit="m",
        lower=0.01,
        upper=3.0,
    )
    wrap_clearance_m: float = option(
        "how far the vehicle stays clear of the bar when the wrap begins", 0.08, unit="m", lower=0.0, upper=0.3
    )
    bend_speed_rad_per_s: float = option("bending and unbending", 0.9, unit="rad/s", lower=0.01, upper=10.0)
    grip_tension_n: float = option(
        "tension of the tightest tendon that means gripped; a free arm at the full wrap has less",
        21.5,
        unit="N",
        lower=1.0,
        upper=200.0,
    )
    verify_pull_m: float = option("set-point offset of the pull test", 0.05, unit="m", lower=0.005, upper=0.5)
    verify_give_share: float = option(
        "share of that offset which a good grip gives at most", 0.3, lower=0.05, upper=0.95
    )
    jog_max_m: float = option("largest move of the anchored vehicle", 0.03, unit="m", lower=0.001, upper=0.2)
    contact_timeout_s: float = option("time for the reach", 40.0, unit="s", lower=1.0, upper=300.0)
    state_timeout_s: float = option("time for any other moving state", 30.0, unit="s", lower=1.0, upper=600.0)


@dataclass(frozen=True)
class RecordConfig:
    """[record] The daemon's own log."""

    directory: str = option("where records go, one file a start; empty: none unless `file` is set", "")
    file: str = option("this very file instead, overwritten at each start", "")


@dataclass(frozen=True)
class RatesConfig:
    """[rates] Cycle and telemetry."""

    cycle_hz: float = option("observe-step-act-record", 100.0, unit="Hz", lower=10.0, upper=500.0)
    status_hz: float = option("ARM_STATUS", 10.0, unit="Hz", lower=0.0, upper=100.0)
    tendons_hz: float = option("ARM_TENDONS", 10.0, unit="Hz", lower=0.0, upper=100.0)
    wrench_hz: float = option("ARM_REACTION_WRENCH", 20.0, unit="Hz", lower=0.0, upper=200.0)
    stiffness_hz: float = option("ARM_STIFFNESS", 1.0, unit="Hz", lower=0.0, upper=20.0)
    payload_hz: float = option("ARM_PAYLOAD, while one is estimated", 1.0, unit="Hz", lower=0.0, upper=50.0)
    mirrors_hz: float = option("NAMED_VALUE_FLOAT and DEBUG_FLOAT_ARRAY", 1.0, unit="Hz", lower=0.0, upper=20.0)


@dataclass(frozen=True)
class SimBarConfig:
    """[sim.bar] The bar as it really is in the plant; the daemon knows only [perch]."""

    position_m: tuple[float, ...] = option(
        "point on the axis, world NED", (3.0, 0.0, -2.0), unit="m", lower=-100.0, upper=100.0, length=3
    )
    axis_deg: float = option("heading of the axis", 90.0, unit="deg", lower=-180.0, upper=180.0)
    radius_m: float = option("radius", 0.035, unit="m", lower=0.002, upper=0.2)
    friction: float = option("Coulomb coefficient against the arm", 0.8, lower=0.0, upper=3.0)


@dataclass(frozen=True)
class SimConfig:
    """[sim] The simulated world: plant, autopilot stand-in and servo emulator."""

    seed: int = option("of every random number in the world", 1, lower=0, upper=2**31 - 1)
    step_s: float = option("physics step", 0.001, unit="s", lower=1e-4, upper=0.004)
    takeoff_height_m: float = option("height of the take-off", 2.2, unit="m", lower=0.5, upper=50.0)
    position_noise_m: float = option("estimator noise, one sigma", 0.004, unit="m", lower=0.0, upper=1.0)
    wind_m_per_s: tuple[float, ...] = option(
        "steady wind, NED", (0.0, 0.0, 0.0), unit="m/s", lower=-30.0, upper=30.0, length=3
    )
    autopilot_url: str = option("the stand-in's companion port", "udpout:127.0.0.1:14540")
    operator_autopilot_url: str = option("where the operator hears the autopilot", "udpin:127.0.0.1:14550")
    operator_arm_url: str = option("where the operator hears the daemon", "udpin:127.0.0.1:14560")
    bar: SimBarConfig = section(SimBarConfig)


@dataclass(frozen=True)
class Config:
    """A whole configuration file."""

    arm: ArmConfig = section(ArmConfig)
    mount: MountConfig = section(MountConfig)
    vehicle: VehicleConfig = section(VehicleConfig)
    links: Mapping[str, LinkConfig] = field(default_factory=dict)
    mavlink: MavlinkConfig = section(MavlinkConfig)
    servos: ServosConfig = section(ServosConfig)
    limits: LimitsConfig = section(LimitsConfig)
    perch: PerchConfig = section(PerchConfig)
    rates: RatesConfig = section(RatesConfig)
    record: RecordConfig = section(RecordConfig)
    sim: SimConfig = section(SimConfig)

    def __post_init__(self) -> None:
        if len(self.servos.ids) != len(self.arm.tendons.angles_deg):
            raise ConfigError(
                f"servos.ids has {len(self.servos.ids)} entries for {len(self.arm.tendons.angles_deg)} tendons"
            )
        if self.perch.wrap_bend_rad > self.limits.bend_max_rad:
            raise ConfigError(
                f"perch.wrap_bend_rad = {self.perch.wrap_bend_rad:g} is over limits.bend_max_rad = "
                f"{self.limits.bend_max_rad:g}"
            )
        if sum(link.role == "autopilot" for link in self.links.values()) > 1:
            raise ConfigError("links: more than one link has the role autopilot")
