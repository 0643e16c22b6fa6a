"""Options of the grasp, and of the object in the simulated world."""

from dataclasses import dataclass

from arm_companion.config.options import option


@dataclass(frozen=True)
class GraspConfig:
    """[grasp] Picking an object up, carrying it and putting it down; reach and wrap are those of [perch]."""

    kind: str = option(
        "what holds the object: the arm, wrapped around it, or the gripper at its tip, from above",
        "wrap",
        choices=("wrap", "gripper"),
    )
    object_position_m: tuple[float, ...] = option(
        "middle of the object's axis, world NED from the autopilot's origin, until a target message replaces it",
        (3.0, 0.0, -1.5),
        unit="m",
        lower=-10_000.0,
        upper=10_000.0,
        length=3,
    )
    object_axis_deg: float = option(
        "heading of the object's axis, clockwise from north", 90.0, unit="deg", lower=-180.0, upper=180.0
    )
    object_radius_m: float = option("radius to wrap around", 0.035, unit="m", lower=0.002, upper=0.5)
    grip_tension_n: float = option(
        "tension of the tightest tendon that means closed around the object", 21.5, unit="N", lower=1.0, upper=200.0
    )
    verify_lift_m: float = option("test lift, before the object leaves for good", 0.05, unit="m", lower=0.01, upper=0.5)
    lift_height_m: float = option("from where it lay to where it is carried", 0.4, unit="m", lower=0.05, upper=20.0)
    lift_speed_m_per_s: float = option("up and down with an object", 0.1, unit="m/s", lower=0.02, upper=1.0)
    mass_min_kg: float = option("less than this does not count as held", 0.05, unit="kg", lower=0.0, upper=50.0)
    mass_max_kg: float = option("more than this is not lifted", 0.5, unit="kg", lower=0.01, upper=50.0)
    place_search_m: float = option(
        "how far below where the object lay to look for the ground", 0.06, unit="m", lower=0.0, upper=1.0
    )


@dataclass(frozen=True)
class SimObjectConfig:
    """[sim.object] The object as it really is in the plant, lying across two cradles; the daemon knows only [grasp]."""

    mass_kg: float = option("mass; 0: there is none", 0.0, unit="kg", lower=0.0, upper=50.0)
    position_m: tuple[float, ...] = option(
        "middle of its axis, world NED", (3.0, 0.0, -1.5), unit="m", lower=-100.0, upper=100.0, length=3
    )
    axis_deg: float = option("heading of the axis", 90.0, unit="deg", lower=-180.0, upper=180.0)
    radius_m: float = option("radius", 0.035, unit="m", lower=0.005, upper=0.2)
    length_m: float = option("length", 0.3, unit="m", lower=0.05, upper=1.5)
    friction: float = option("Coulomb coefficient against arm and cradles", 0.8, lower=0.0, upper=3.0)
