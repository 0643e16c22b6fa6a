"""Options of REACH: the tip to a point in the world, by arm and vehicle together."""

from dataclasses import dataclass

from arm_companion.config.options import option


@dataclass(frozen=True)
class ReachConfig:
    """[reach] Bringing the tip to a point: how the way is shared between vehicle and arm, and its limits."""

    vehicle_weight: float = option(
        "how much a move of the vehicle by an arm's length weighs against a bend of a radian; 0: the vehicle does all. "
        "From 3 on the best split could jump while the point moves on",
        1.0,
        lower=0.0,
        upper=2.9,
    )
    move_max_m: float = option("farthest that one REACH moves the vehicle", 3.0, unit="m", lower=0.0, upper=50.0)
    height_min_m: float = option(
        "least height of the vehicle above the autopilot's origin", 0.5, unit="m", lower=-1000.0, upper=1000.0
    )
    clearance_m: float = option(
        "least distance between the vehicle's centre of mass and the point, on all of the way",
        0.15,
        unit="m",
        lower=0.0,
        upper=5.0,
    )
    speed_m_per_s: float = option(
        "of the vehicle's set-point; never over limits.vehicle_speed_m_per_s", 0.3, unit="m/s", lower=0.01, upper=3.0
    )
    acceleration_m_per_s2: float = option("of the vehicle's set-point", 0.3, unit="m/s^2", lower=0.02, upper=2.0)
    correction_max_rad: float = option(
        "most that the arm bends beside its plan to make up for where the vehicle really is; 0: it does not",
        0.8,
        unit="rad",
        lower=0.0,
        upper=3.0,
    )
    tolerance_m: float = option("a tip as near as this is at its point", 0.02, unit="m", lower=0.001, upper=0.5)
    state_timeout_s: float = option("time until the tip is at its point", 40.0, unit="s", lower=1.0, upper=600.0)
