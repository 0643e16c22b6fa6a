"""Options of the flight: limits, the perch, rates, the record, and the simulated world."""

import math
from dataclasses import dataclass

from arm_companion.config.grasp_options import SimObjectConfig
from arm_companion.config.gripper_options import SimGripperConfig
from arm_companion.config.options import option, section


@dataclass(frozen=True)
class KeepOutConfig:
    """[limits.keep_out] A cone that the arm never enters: around propellers, landing gear and hull."""

    apex_m: tuple[float, ...] = option(
        "its apex from the airframe's centre of mass, body axes; from there it opens towards that centre and beyond",
        (0.0, 0.0, 0.05),
        unit="m",
        lower=-2.0,
        upper=2.0,
        length=3,
    )
    half_angle_deg: float = option(
        "between its axis and its surface; 0: no cone", 0.0, unit="deg", lower=0.0, upper=89.0
    )


@dataclass(frozen=True)
class LimitsConfig:
    """[limits] What no command that leaves may exceed."""

    tension_min_n: float = option(
        "least tension of every tendon, not over the pretension", 0.5, unit="N", lower=0.0, upper=50.0
    )
    tension_max_n: float = option("greatest tension of any tendon", 45.0, unit="N", lower=1.0, upper=500.0)
    tension_disagreement_sigma: float = option(
        "a tendon whose load and statics differ by so many sigma counts as broken or jumped", 4.0, lower=1.0, upper=50.0
    )
    tension_disagreement_s: float = option("for how long they must differ", 0.5, unit="s", lower=0.05, upper=30.0)
    pull_max_m: float = option("tendon taken in or let out, from straight", 0.12, unit="m", lower=0.001, upper=2.0)
    pull_speed_m_per_s: float = option("tendon speed", 0.05, unit="m/s", lower=0.001, upper=1.0)
    bend_max_rad: float = option("commanded bend of the free arm", 5.5, unit="rad", lower=0.1, upper=4 * math.pi)
    wrench_force_n: float = option("predicted force on the airframe", 12.0, unit="N", lower=0.1, upper=500.0)
    wrench_moment_nm: float = option("predicted moment on the airframe", 2.5, unit="N m", lower=0.01, upper=200.0)
    vehicle_speed_m_per_s: float = option("set-point speed near the bar", 0.3, unit="m/s", lower=0.01, upper=5.0)
    feedforward_m_per_s2: float = option("acceleration feed-forward", 3.5, unit="m/s^2", lower=0.0, upper=8.0)
    keep_out: KeepOutConfig = section(KeepOutConfig)


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
        "share of that offset which a good grip gives at most, beyond its arm's stretch", 0.3, lower=0.05, upper=0.95
    )
    attempts: int = option(
        "approaches of one PERCH or GRASP that finds nothing, or whose grip does not hold", 2, lower=1, upper=5
    )
    slide_force_n: float = option(
        "most that a vertical move pushes against a wrap, which slides on its bar rather than stretch; 0 does not push",
        1.5,
        unit="N",
        lower=0.0,
        upper=50.0,
    )
    jog_max_m: float = option("largest move of the anchored vehicle", 0.03, unit="m", lower=0.001, upper=0.2)
    jog_speed_m_per_s: float = option(
        "speed of such a move; a fast one overshoots, because the arm turns the airframe with it",
        0.004,
        unit="m/s",
        lower=0.0005,
        upper=0.05,
    )
    contact_timeout_s: float = option("time for the reach", 40.0, unit="s", lower=1.0, upper=300.0)
    state_timeout_s: float = option("time for any other moving state", 30.0, unit="s", lower=1.0, upper=600.0)


@dataclass(frozen=True)
class RecordConfig:
    """[record] The daemon's own log."""

    directory: str = option("where records go, one file a start; empty: none unless `file` is set", "")
    file: str = option("this very file instead, overwritten at each start", "")
    part_mb: float = option(
        "a record goes on in another file beyond this size, or a quarter of the budget",
        200.0,
        unit="MB",
        lower=1.0,
        upper=1e5,
    )
    budget_mb: float = option(
        "most that all records of the directory take, the oldest are deleted; 0: any",
        4000.0,
        unit="MB",
        upper=1e7,
        lower=0.0,
    )
    keep_free_mb: float = option("space that records leave free on the disk", 200.0, unit="MB", lower=0.0, upper=1e6)
    raw: bool = option("whether the raw bytes of all links and of the servo bus are recorded", default=True)
    raw_kb_per_s: float = option("most of those bytes that are kept", 200.0, unit="kB/s", lower=1.0, upper=1e4)


@dataclass(frozen=True)
class RatesConfig:
    """[rates] Cycle and telemetry."""

    cycle_hz: float = option("observe-step-act-record", 100.0, unit="Hz", lower=10.0, upper=500.0)
    status_hz: float = option("ARM_STATUS", 10.0, unit="Hz", lower=0.0, upper=100.0)
    tendons_hz: float = option("ARM_TENDONS", 10.0, unit="Hz", lower=0.0, upper=100.0)
    servos_hz: float = option("ARM_SERVOS", 1.0, unit="Hz", lower=0.0, upper=100.0)
    wrench_hz: float = option("ARM_REACTION_WRENCH", 20.0, unit="Hz", lower=0.0, upper=200.0)
    stiffness_hz: float = option("ARM_STIFFNESS", 1.0, unit="Hz", lower=0.0, upper=20.0)
    payload_hz: float = option("ARM_PAYLOAD, while one is estimated", 1.0, unit="Hz", lower=0.0, upper=50.0)
    computer_hz: float = option("ONBOARD_COMPUTER_STATUS", 0.2, unit="Hz", lower=0.0, upper=1.0)
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
    thrust_curve: float = option(
        "how far rotor thrust is from linear in the commanded share (PX4: THR_MDL_FAC that nobody set)",
        0.3,
        lower=0.0,
        upper=0.9,
    )
    position_noise_m: float = option(
        "noise of the stand-in's estimate, and of motion capture, one sigma", 0.004, unit="m", lower=0.0, upper=1.0
    )
    position_wander_m: float = option(
        "slow wandering of the stand-in's position on top, as by satellites and a barometer (0.02), one sigma",
        0.0,
        unit="m",
        lower=0.0,
        upper=1.0,
    )
    sitl_position: str = option(
        "where a real flight stack knows its position from: motion capture, or satellites and barometer",
        "capture",
        choices=("capture", "satellites"),
    )
    wind_m_per_s: tuple[float, ...] = option(
        "steady wind, NED", (0.0, 0.0, 0.0), unit="m/s", lower=-30.0, upper=30.0, length=3
    )
    gust_m_per_s: float = option(
        "greatest peak of the gusts on top of it, from any side; 0: none", 0.0, unit="m/s", lower=0.0, upper=30.0
    )
    autopilot_url: str = option("the stand-in's companion port", "udpout:127.0.0.1:14540")
    operator_autopilot_url: str = option("where the operator hears the autopilot", "udpin:127.0.0.1:14550")
    operator_arm_url: str = option("where the operator hears the daemon", "udpin:127.0.0.1:14560")
    bar: SimBarConfig = section(SimBarConfig)
    object: SimObjectConfig = section(SimObjectConfig)
    gripper: SimGripperConfig = section(SimGripperConfig)
