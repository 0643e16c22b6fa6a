"""What plant, autopilot stand-in and servo emulator tell each other: values, never references.

World axes are NED with the origin at the vehicle's centre of mass where it stands before take-off.
Quaternions are (w, x, y, z) and turn body axes (FRD) into world axes.
"""

from dataclasses import dataclass

Vec3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class RigidState:
    """True motion of the airframe."""

    position_w: Vec3  # m, centre of mass
    velocity_w: Vec3  # m/s
    attitude_wb: tuple[float, float, float, float]
    rate_b: Vec3  # rad/s
    specific_force_b: Vec3  # m/s^2, what an accelerometer at the centre of mass reads


@dataclass(frozen=True, slots=True)
class RotorCommand:
    """What the rotors exert on the airframe now (motor lag is the autopilot stand-in's part)."""

    thrust_n: float  # along -z of the body
    torque_b: Vec3  # N m


@dataclass(frozen=True, slots=True)
class PlantTruth:
    """What only the plant knows, for verdicts and figures; nothing of it reaches the daemon."""

    force_b: Vec3  # N, of the arm on the airframe, body axes
    torque_b: Vec3  # N m, of the arm on the airframe about the airframe's centre of mass, body axes
    contact_force_n: float  # sum of the normal forces between arm and bar or object
    contact_net_w: Vec3  # N, net force of bar or object on the arm, world axes
    wrap_angle: float  # rad of the bar's circumference that the arm's contacts span, seen along its axis
    tension: tuple[float, ...]  # N, true tendon tensions
    tip_position_w: Vec3  # m
    body_contact: bool  # the airframe itself touches bar, object, cradles or ground
    mount_only: bool = False  # of the airframe, nothing touches but the mount of the arm
    rotor_contact: bool = False  # something, the arm too, reaches into a propeller's disk
    object_position_w: Vec3 | None = None  # m, middle of the object; None: there is none
    object_supported: bool = False  # it touches cradles or ground


@dataclass(frozen=True, slots=True)
class Touch:
    """What the airframe touches: bar, object, cradles or ground, with the arm's mount or elsewhere."""

    by_mount: bool = False
    elsewhere: bool = False
    rotor: bool = False  # something, the arm too, reaches into a propeller's disk

    @property
    def body(self) -> bool:
        """Any of the first two."""
        return self.by_mount or self.elsewhere

    @property
    def mount_only(self) -> bool:
        """Nothing touches but the mount."""
        return self.by_mount and not self.elsewhere

    def and_then(self, later: "Touch") -> "Touch":
        """What was touched in either."""
        if later is NOTHING:
            return self
        return Touch(self.by_mount or later.by_mount, self.elsewhere or later.elsewhere, self.rotor or later.rotor)


NOTHING = Touch()
