"""What the mission remembers from one cycle to the next."""

import enum
import math
from dataclasses import dataclass, field

from arm_companion.arm.model import ArmSolution
from arm_companion.mission.course import Course
from arm_companion.mission.estimate import ForceObserver
from arm_companion.mission.facts import ArmFault, Control, Order, Quaternion, StiffnessReport, Vec3, WrenchReport
from arm_companion.mission.glide import Glide
from arm_companion.mission.gripper_facts import NO_GRIP, Grip
from arm_companion.mission.motion import ZERO, Reference
from arm_companion.mission.payload import NO_LOAD, Load
from arm_companion.mission.tendon_watch import Expected, TendonWatch
from arm_companion.record_codec import UNRECORDED


class Phase(enum.Enum):
    """States of perches and grasp, each in the order of a flight; the value is the number of ARM_STATE."""

    STARTUP = 0
    STOWED = 1
    READYING = 2
    READY = 3
    APPROACH = 4
    REACH = 5
    CONTACT = 6
    WRAP = 7
    VERIFY = 8
    PERCHED = 9
    UNLOAD = 10
    RELEASE = 11
    DEPART = 12
    STOWING = 13
    HOLDING = 14
    LOAD_TRANSFER = 15
    CLOSE = 16
    LIFT = 17
    CARRY = 18
    PLACE = 19
    CALIBRATING = 20
    HANGING = 22
    TAKE_BACK = 23
    HANG_HOLD = 24
    TIP_MOVE = 25
    TIP_HOLD = 26
    EASING = 27

    __hash__ = object.__hash__  # an enumeration's own takes longer than the look-up, dozens of times in a cycle


CARRYING = frozenset({Phase.LIFT, Phase.CARRY, Phase.PLACE})
"""Phases in which the vehicle alone holds up what the arm holds."""

CALIBRATES = frozenset({Phase.CALIBRATING, Phase.EASING})
"""Phases in which tendons are wound one by one, from slack to tight, wherever their zeros are."""

TIP = frozenset({Phase.TIP_MOVE, Phase.TIP_HOLD})
"""Phases in which the tip is brought to a point in the world, and kept there."""

MOVES_VEHICLE = (
    CARRYING
    | TIP
    | frozenset(
        {
            Phase.APPROACH,
            Phase.REACH,
            Phase.CONTACT,
            Phase.WRAP,
            Phase.CLOSE,
            Phase.VERIFY,
            Phase.PERCHED,
            Phase.UNLOAD,
            Phase.RELEASE,
            Phase.DEPART,
            Phase.LOAD_TRANSFER,
            Phase.HANGING,
            Phase.TAKE_BACK,
        }
    )
)
"""Phases whose set-points the vehicle must follow."""


@dataclass(frozen=True)
class Running:
    """The order that is being carried out, and where it ends."""

    request: int
    order: Order
    done: frozenset[Phase]
    since: float = 0.0  # loop time


@dataclass(frozen=True)
class Anchor:
    """Vehicle and arm at the moment when the grip was taken for good, and the bar: another may be told meanwhile.

    Attributes:
        position_w: of the vehicle, m.
        attitude_wb: of the vehicle.
        tension: of each tendon, N.
        section_position_a: where the bar holds the arm, base axes of that moment, m.
        section_attitude_as: of the held cross-section in those axes.
        beyond: by how much the wrapped part shortens each tendon's path, m; empty when the model found none.
        bar_radius: of the bar that it holds, m; None: that of the bar that is told.
        bar_axis_w: its direction, unit; None: the same.
    """

    position_w: Vec3
    attitude_wb: Quaternion
    tension: tuple[float, ...]
    section_position_a: Vec3 = ZERO
    section_attitude_as: Quaternion = (1.0, 0.0, 0.0, 0.0)
    beyond: tuple[float, ...] = ()
    bar_radius: float | None = None
    bar_axis_w: Vec3 | None = None


@dataclass(frozen=True)
class Prediction:
    """What the arm's mechanics say, found anew a few times while the cycle runs."""

    t: float  # loop time
    wrench: WrenchReport
    tip_a: Vec3  # m, base axes
    bend: tuple[float, float]  # rad, that the measured displacements stand for
    lean: Vec3  # m/s^2, world: the acceleration that holds the reference against the arm
    tensions: tuple[Expected, ...] = ()  # what the statics say of each tendon; empty when they say nothing
    # where the next solves start; they follow from what was recorded before, so they are recorded once in a while
    free: ArmSolution | None = field(default=None, compare=False, repr=False, metadata=UNRECORDED)
    anchored: ArmSolution | None = field(default=None, compare=False, repr=False, metadata=UNRECORDED)
    stiffness: StiffnessReport | None = field(default=None, compare=False, repr=False, metadata=UNRECORDED)


FOLLOWS = CARRYING | TIP | frozenset({Phase.APPROACH, Phase.REACH, Phase.DEPART})
"""Phases in which nothing but air is between the vehicle and its reference."""


@dataclass(frozen=True)
class Vigil:
    """For how long each doubtful fact has held, s, and where the vehicle was when it was seen last.

    Attributes:
        position_w: of the vehicle when it was fresh last, m; None: too long ago to be compared with.
        velocity_w: of the vehicle then, m/s.
        unseen_s: for how long it has not been fresh.
        astray_s: a free vehicle is far from its reference.
        hot_s: a servo is close to its temperature limit.
        low_s: the supply is close to its lower limit.
        slack_s: a tendon is surely under its least tension.
        tight_s: a tendon reads more than its greatest tension.
        blind_s: the mechanics have no solution.
        unheard_s: a servo has not been heard.
        rested_s: the vehicle is where a reference at rest has it.
        rocking: mean square of its rates of roll and pitch over the last second or so, (rad/s)^2.
        jumps: of the estimator, loop time and way, m: what is told after one is in its frame.
        jumped_at: loop time of the last jump.
        leap_m: its size.
    """

    position_w: Vec3 | None = None
    velocity_w: Vec3 = ZERO
    unseen_s: float = 0.0
    astray_s: float = 0.0
    hot_s: float = 0.0
    low_s: float = 0.0
    slack_s: float = 0.0
    tight_s: float = 0.0
    blind_s: float = 0.0
    unheard_s: float = 0.0
    rested_s: float = 0.0
    rocking: float = 0.0
    jumps: tuple[tuple[float, Vec3], ...] = ()
    jumped_at: float = 0.0
    leap_m: float = 0.0


class PerchKind(enum.Enum):
    """How the vehicle perches, ARM_PERCH_KIND."""

    ANCHOR = 0
    HANG = 1


@dataclass(frozen=True)
class Sharing:
    """How arm and motors share the vehicle's weight while it hangs, or is about to.

    Attributes:
        hover: throttle of the free hover, share of full; 0: not known.
        share: of the hover's thrust that is asked for now; 1 hovers.
        step: the share that the present step goes to.
        trim: acceleration that makes the measured throttle the asked one, m/s^2 down.
        rested_s: for how long the vehicle has been at rest in this step.
        carried_s: for how long the motors have carried the vehicle again.
        dropped_s: for how long they no longer have, while the arm lets go.
        place: of the vehicle, m, followed slowly: a slip is a fast move away from it.
        first: height of the vehicle when the load began to move, m, NED.
    """

    hover: float = 0.0
    share: float = 1.0
    step: float = 1.0
    trim: float = 0.0
    rested_s: float = 0.0
    carried_s: float = 0.0
    dropped_s: float = 0.0
    place: Vec3 = ZERO
    first: float = 0.0


@dataclass(frozen=True)
class Reach:
    """A point in the world that the tip goes to.

    Attributes:
        target_w: m.
        vehicle_w: where the vehicle hovers for it, m.
        bend: of the plan, rad.
        alone: whether the arm does it while the vehicle stays.
        way_m: of the tip, when it set out.
        vehicle: on its way; only its start while the vehicle stays.
        shape: the bend on its way, rad; z is not used.
        here_w: of the vehicle, from its position and velocity together, m.
        sag_a: from the arc's tip to the real one's, base axes, m.
        error_m: distance of tip and target, by position, attitude and the mechanics.
        within_s: for how long the tip has been at its point.
        unknown_s: for how long the mechanics have not told where it is.
    """

    target_w: Vec3
    vehicle_w: Vec3
    bend: tuple[float, float]
    alone: bool
    way_m: float
    vehicle: Glide
    shape: Glide
    here_w: Vec3
    sag_a: Vec3 = ZERO
    error_m: float = math.inf
    within_s: float = 0.0
    unknown_s: float = 0.0


@dataclass(frozen=True)
class State:
    """Memory of the mission: plain values, so that a record holds all of it."""

    phase: Phase = Phase.STARTUP
    since: float = 0.0  # loop time of entry
    t: float = 0.0  # loop time of the previous step
    running: Running | None = None
    task: Order = Order.PERCH  # what the arm reaches out for: PERCH or GRASP
    way_m: float = 0.0  # of the last approach, or of setting a load down, when it began
    tries: int = 0  # approaches since it was ordered
    control: Control = Control.UNKNOWN  # of the previous step, to see the pilot take over
    armed: bool = False  # of the previous step, to see the motors stop
    streaming: bool = False  # set-points go out
    moved_at: float | None = None  # loop time of the last that moved the vehicle; None: who flies now is not ours
    bend: tuple[float, float] = (0.0, 0.0)  # rad, commanded now
    bend_goal: tuple[float, float] = (0.0, 0.0)  # rad
    streamed: bool = False  # the goal comes from a stream of set-points
    pulls: tuple[float, ...] = ()  # m, tendon goals that belong to `bend`; empty: not found yet
    reference: Reference | None = None
    contact_w: Vec3 | None = None  # m, vehicle reference when contact was found; None: nobody knows where
    heading: float = 0.0  # rad, at which the vehicle faces the bar
    force: ForceObserver = ForceObserver()
    tension: tuple[float, ...] = ()  # N, smoothed, each while its servo moved last
    watch: tuple[TendonWatch, ...] = ()  # of each tendon
    vigil: Vigil = Vigil()
    load: Load = NO_LOAD  # what the rotors lift beyond the vehicle
    grip: Grip = NO_GRIP  # what the gripper was told, and does
    feedforward: bool = True  # switched on
    position: Vec3 = ZERO  # m, of the vehicle, smoothed: millimetres decide about newtons
    anchor: Anchor | None = None
    rest: Vec3 | None = None  # m, where the anchored vehicle stays by itself; moves are counted from here
    prediction: Prediction | None = None
    lean: Vec3 = ZERO  # m/s^2, acceleration fed forward now
    felt: Vec3 = ZERO  # m/s^2, as much of it as has come through the observers' lag
    offset: Vec3 = ZERO  # m, asked move away from the anchor
    kind: PerchKind = PerchKind.ANCHOR  # of the perch ordered last
    sharing: Sharing = Sharing()
    reach: Reach | None = None  # of the REACH ordered last
    course: Course | None = None  # of the calibration under way
    errors: ArmFault = ArmFault.NONE  # latched until the next READY, PERCH or CALIBRATE
    warned: frozenset[str] = frozenset()  # notices already given in this phase

    @property
    def perches_below(self) -> bool:
        """Whether the target is a bar that the vehicle is to fly above, with its arm around it."""
        return self.task is not Order.GRASP and self.kind is PerchKind.ANCHOR
