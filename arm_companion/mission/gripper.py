"""The gripper at the tip: when its jaws open and close, what tells that they did, and the way to what they take.

It is opened in two phases only: in APPROACH, with nothing held yet, and in RELEASE, which a load reaches in the two
ways that `grasp` names. In all others the last order stands, so that a fault never lets go.
"""

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.facts import Vec3
from arm_companion.mission.gripper_facts import Grip, GripperAction, GripperAnswer, GripperFate, GripperOrder, JawState
from arm_companion.mission.motion import arrived
from arm_companion.mission.situation import Situation, at
from arm_companion.mission.state import Phase, State
from arm_companion.values import replace

_OPEN = 0.1  # of the travel, up to which jaws count as open
_SHUT = 0.96  # of the travel, from which on nothing is between them
_STANDS_PER_S = 0.1  # of the travel; slower jaws stand
_HELD_S = 0.3
_HELD_AT_START_SHARE = 0.7  # of gripper.load_min: gears hide some of the load of a servo that has stood for long
_TOUCH_S = 0.15
_NEAR_M = 0.15  # from here on the object may be touched at any moment
_FAR_FACTOR = 3.0
_AT_GRIP_M = 0.03
_PLUCK_S = 1.0
_ROSE_M = 0.01

_ORDERS = {
    Phase.APPROACH: GripperAction.OPEN,
    Phase.CLOSE: GripperAction.CLOSE,
    Phase.RELEASE: GripperAction.OPEN,
}


def begin(s: Situation) -> State:
    """Memory at the entry of the present phase: what the jaws are told, and what they are to wait for."""
    state = s.state
    action = _ORDERS.get(state.phase)
    # what an arm lets go of after a restart, nobody remembers
    if not s.config.gripper_by or action is None or not (s.grasping or state.phase is Phase.RELEASE):
        return state
    state = replace(state, grip=replace(state.grip, order=GripperOrder(action, s.t), held_s=0.0))
    if state.phase is Phase.CLOSE:
        return replace(state, bend_goal=state.bend)  # the arm stays as it is
    return state


def settled(before: State, s: Situation) -> State:
    """Memory once this cycle's phase stands: what one that was left at once had ordered, the jaws are not told.

    A person says RELEASE in the cycle in which the motors stop: the arm holds on, and so do the jaws.
    """
    grip = s.state.grip
    if grip.order == before.grip.order or s.state.phase in _ORDERS:
        return s.state
    return replace(s.state, grip=replace(grip, order=before.grip.order, held_s=before.grip.held_s))


def touching(s: Situation) -> State:
    """Memory at the entry of CONTACT: the vehicle stays where the object is between the jaws, or under them."""
    reference = s.state.reference
    below = reference is not None and arrived(reference, s.place(0.0))
    return replace(s.state, contact_w=s.place(0.0) if below else s.state.position)


def watch(s: Situation) -> Grip:
    """What is remembered of the gripper after this cycle."""
    grip, jaws = s.state.grip, s.jaws
    if not s.config.gripper_by:
        return grip
    touch = s.gripping and s.state.phase is Phase.REACH and _felt_below(s)
    return replace(
        grip,
        held_s=grip.held_s + s.dt if jaws is not None and _closing(grip) and _held(s, jaws) else 0.0,
        touch_s=grip.touch_s + s.dt if touch else 0.0,
    )


# --- what is known of the jaws ---


def is_open(s: Situation) -> bool:
    """Whether the jaws are open since they were last told to; an arm without a gripper has nothing to open."""
    order = s.state.grip.order
    if not s.config.gripper_by:
        return True
    if order is None or order.action is not GripperAction.OPEN:
        return False
    if (jaws := s.jaws) is not None:
        return stand_open(jaws)
    return _taken(s)


def stand_open(jaws: JawState) -> bool:
    """Whether a servo's jaws are surely open, whoever opened them."""
    return jaws.homed and not jaws.silent and jaws.closed <= _OPEN


def is_shut(s: Situation) -> bool:
    """Whether closing jaws have met, so that nothing is between them; an autopilot's do not tell."""
    jaws = s.jaws
    return jaws is not None and _closing(s.state.grip) and not jaws.silent and jaws.closed >= _SHUT


def holds(s: Situation) -> bool:
    """Whether closed jaws have something between them; an autopilot's are believed to."""
    if not _closing(s.state.grip):
        return False
    return s.state.grip.held_s >= _HELD_S if s.jaws is not None else _taken(s)


def closed(s: Situation) -> str | None:
    """The jaws have closed on something; with an autopilot, they have had time to close."""
    jaws = s.jaws
    if jaws is None:
        moving = s.config.gripper.moving_s
        return f"the autopilot's gripper has had {moving:g} s to close" if _taken(s) else None
    if s.state.grip.held_s < _HELD_S:
        return None
    return f"gripper closed by {jaws.closed:.0%} with {jaws.load:.0%} load"


def not_closed(s: Situation) -> str | None:
    """The jaws have closed on nothing, or do not close."""
    jaws, answer = s.jaws, _answer(s)
    if answer is not None and answer.fate is GripperFate.REFUSED:
        return f"gripper: {answer.reason}"
    if jaws is not None and is_shut(s):
        return "the gripper closed on nothing"
    if s.elapsed <= s.config.gripper.timeout_s or closed(s) is not None:
        return None
    how = "" if jaws is None else f": {jaws.closed:.0%} closed with {jaws.load:.0%} load"
    return f"the gripper did not close within {s.config.gripper.timeout_s:g} s{how}"


# --- rows ---


def does_not_open(s: Situation) -> str | None:
    """The jaws are not open in time, so that the tip must not go down onto the object."""
    order, answer = s.state.grip.order, _answer(s)
    if not s.gripping or order is None or is_open(s):
        return None
    if answer is not None and answer.fate is GripperFate.REFUSED:
        return f"gripper: {answer.reason}"
    late = s.t - order.at > s.config.gripper.timeout_s
    return f"the gripper did not open within {s.config.gripper.timeout_s:g} s" if late else None


def at_object(s: Situation) -> str | None:
    """The object is between the open jaws, by height, or the tip stands on something."""
    reference = s.state.reference
    if not s.gripping or reference is None or not is_open(s):
        return None
    if s.state.grip.touch_s >= _TOUCH_S:
        return f"contact: {-s.state.load.now * GRAVITY:.1f} N from below"
    grip = s.place(0.0)
    return "object between the jaws" if arrived(reference, grip) and at(s, grip, _AT_GRIP_M) else None


def holds_at_start(s: Situation) -> str | None:
    """The daemon finds a gripper that holds something, or may do so: it is left as it is."""
    if not s.heard or not s.config.gripper_by:
        return None
    if (jaws := s.jaws) is None:
        return "what the autopilot's gripper holds in flight is not known" if s.facts.vehicle.armed else None
    pulls = jaws.torque and jaws.load >= _HELD_AT_START_SHARE * s.config.gripper.load_min
    return f"gripper found holding with {jaws.load:.0%} load" if pulls and jaws.closed < _SHUT else None


# --- the way to the object ---


def goal(s: Situation) -> tuple[Vec3, float]:
    """Where the reference goes in REACH and CONTACT, from above, and how fast; closed jaws wait at the stand-off."""
    perch = s.config.perch
    if s.state.phase is Phase.CONTACT:
        return s.contact_w, perch.reach_speed_m_per_s
    if not is_open(s):
        return s.standoff, perch.reach_speed_m_per_s
    far = _above_grip(s) > _NEAR_M
    return s.place(0.0), (_FAR_FACTOR if far else 1.0) * perch.reach_speed_m_per_s


def lifted_from(s: Situation) -> Vec3:
    """Vehicle position from which the test lift begins, and to which the object is brought back: above the grip."""
    x, y, _ = s.contact_w
    return x, y, s.state.position[2]


def pluck(s: Situation) -> float:
    """Load, kg, that the test lift pushes for until the vehicle rises, whatever it feels so far.

    A tip that is held turns the vehicle the wrong way: what pushes it aside tilts it, by its lever under the centre of
    mass, towards where it is pushed from. So the object is to leave its place at once (docs/adr/0033).
    """
    rose = s.probe[2] - s.state.position[2] > _ROSE_M
    return 0.0 if rose else s.config.grasp.mass_max_kg * min(s.elapsed / _PLUCK_S, 1.0)


def _above_grip(s: Situation) -> float:
    """How far the vehicle is above where it grips, m."""
    return s.place(0.0)[2] - s.facts.vehicle.position_w[2]


def _felt_below(s: Situation) -> bool:
    """Whether the rotors lift so much less than the vehicle that the tip must stand on something."""
    return -s.state.load.now * GRAVITY > s.config.perch.contact_force_n and _above_grip(s) < _NEAR_M


def _held(s: Situation, jaws: JawState) -> bool:
    heard = jaws.torque and not jaws.silent
    return heard and jaws.closed < _SHUT and abs(jaws.speed) < _STANDS_PER_S and jaws.load >= s.config.gripper.load_min


def _closing(grip: Grip) -> bool:
    return grip.order is not None and grip.order.action is GripperAction.CLOSE


def _answer(s: Situation) -> GripperAnswer | None:
    """The autopilot's answer to the present order; None while there is none."""
    order, gripper = s.state.grip.order, s.facts.gripper
    if order is None or gripper is None or gripper.answer is None or gripper.answer.at != order.at:
        return None
    return gripper.answer


def _taken(s: Situation) -> bool:
    """Whether the autopilot took the present order, long enough ago for the jaws to have followed."""
    answer = _answer(s)
    return answer is not None and answer.fate is GripperFate.TAKEN and answer.since_s >= s.config.gripper.moving_s
