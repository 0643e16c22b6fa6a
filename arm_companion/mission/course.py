"""A guided procedure carried out by the mission: one action after the other, a little in each cycle.

The procedure is a generator, and memory is plain values. So what memory has is every answer that the procedure was
given, and where the generator stands follows from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from arm_companion.mission.facts import TendonState
from arm_companion.procedures.actions import Action, Ask, Engage, Keep, Move, Procedure, Refused, Release, Sample, Say
from arm_companion.procedures.moves import Moving
from arm_companion.procedures.tendon_zeros import Setup, Zero, procedure
from arm_companion.record_codec import UNRECORDED
from arm_companion.values import replace

_TORQUE_S = 2.0
_PAUSE_S = 1.0
_REST_S = 0.3
_IN_TENDON = (0, 2, 9)  # per cent of all, after so many moves with one of four tendons
_OF_TENDON = 18
_SLACK = 3
_STROKES = 20


@dataclass(frozen=True)
class Course:
    """How far the procedure has come.

    Attributes:
        origin: pull of each tendon when it began, m; goals are counted from there.
        held: whether the torque was on then.
        goal: where the tendons are asked to be, m wound up since then.
        waited_s: for how long the present action has waited.
        found: tendons whose zero is known roughly.
        moves: made since the last of them.
        said: what people are to be told in this cycle.
        limp: the torque is to be off.
        zeros: the result, in ticks from the present zeros; empty: there is none yet.
        refusal: why the procedure cannot go on; empty: it can.
    """

    origin: tuple[float, ...]
    held: bool
    goal: tuple[float, ...]
    waited_s: float = 0.0
    found: int = 0
    moves: int = 0
    said: str = ""
    limp: bool = False
    zeros: tuple[Zero, ...] = ()
    refusal: str = ""
    # thousands of readings; they follow from facts that were recorded before
    setup: Setup | None = field(default=None, compare=False, repr=False, metadata=UNRECORDED)
    answers: tuple[Any, ...] = field(default=(), compare=False, repr=False, metadata=UNRECORDED)
    moving: Moving | None = field(default=None, compare=False, repr=False, metadata=UNRECORDED)

    @property
    def pulls(self) -> tuple[float, ...]:
        """Goals as pulls, m."""
        return tuple(begin + wound for begin, wound in zip(self.origin, self.goal, strict=True))

    @property
    def ended(self) -> bool:
        """Whether nothing more is to be done."""
        return bool(self.zeros or self.refusal)

    @property
    def progress(self) -> int:
        """Per cent, about as the time goes."""
        if self.zeros:
            return 99
        tendons = self.setup.n if self.setup is not None else len(self.origin)
        begun = 4 * _OF_TENDON * self.found // tendons
        if not (self.found or self.moves):
            return 0
        if self.found == tendons:
            return _SLACK + begun + min(self.moves, _STROKES)
        return _SLACK + begun + 4 * _IN_TENDON[min(max(self.moves - (not self.found), 0), 2)] // tendons


def begin(setup: Setup, tendons: Sequence[TendonState]) -> Course:
    """At the start, nothing done."""
    return Course(tuple(t.pull for t in tendons), any(t.torque for t in tendons), (0.0,) * len(tendons), setup=setup)


def carry_on(course: Course, tendons: Sequence[TendonState], dt: float) -> Course:
    """One cycle of the present action.

    Args:
        course: not ended.
        tendons: as they are now.
        dt: s since the last cycle.
    """
    course = replace(course, said="")
    setup = course.setup
    if setup is None:
        return replace(course, refusal="what was measured so far is not remembered")
    try:
        action = _action_after(setup, course.answers)
        course, answers = _carry_out(course, setup, action, tendons, dt)
        if not answers:
            return course
        course = replace(course, answers=course.answers + answers, waited_s=0.0)
        following = _action_after(setup, course.answers)
    except Refused as refused:
        return replace(course, refusal=str(refused))
    return replace(course, zeros=following) if isinstance(following, tuple) else course


def _carry_out(
    c: Course, setup: Setup, action: Action | tuple[Zero, ...], tendons: Sequence[TendonState], dt: float
) -> tuple[Course, tuple[Any, ...]]:
    """What comes of one cycle, and the answer when the action is done: one, or none.

    Raises:
        Refused: it cannot be done.
    """
    match action:
        case Ask():  # whoever ordered it has said before that nothing touches the arm; it comes to rest meanwhile
            return replace(c, waited_s=c.waited_s + dt), (True,) if c.waited_s >= _PAUSE_S else ()
        case Say(text):
            return replace(c, said=text), (None,)
        case Keep(value):
            return replace(c, found=len(value), moves=0), (None,)
        case Engage() | Release():
            on = isinstance(action, Engage)
            late = [i + 1 for i, tendon in enumerate(tendons) if tendon.torque is not on]
            if late and c.waited_s > _TORQUE_S:
                raise Refused(f"the servo of tendon {late[0]} does not switch its torque {'on' if on else 'off'}")
            c = replace(c, limp=not on, waited_s=c.waited_s + dt)
            zero = tuple(round(d * pull / setup.m_per_tick) for d, pull in zip(setup.directions, c.origin, strict=True))
            return c, () if late else (zero,)
        case Move():
            return _move(c, action, tendons, dt)
    raise Refused(f"nobody is there for {type(action).__name__}")


def _move(c: Course, action: Move, tendons: Sequence[TendonState], dt: float) -> tuple[Course, tuple[Any, ...]]:
    moving = c.moving
    if moving is None:
        moving = Moving(action, c.goal)
    else:
        sample = _sample(c, tendons)
        moving, trace = moving.measured(sample)
        if trace is not None:
            goal = sample.wound if trace.stopped else c.goal  # and no further
            return replace(c, goal=goal, moving=None, moves=c.moves + 1), (trace,)
    moving = moving.on(dt)
    return replace(c, moving=moving, goal=moving.goal), ()


def _sample(c: Course, tendons: Sequence[TendonState]) -> Sample:
    return Sample(
        tuple(t.pull - begin for t, begin in zip(tendons, c.origin, strict=True)),
        tuple(t.load for t in tendons),
        tuple(t.voltage for t in tendons),
        tuple(t.temperature for t in tendons),
    )


def back(course: Course) -> Course:
    """The way back to where the tendons were when the procedure began, to be made with `go_back`."""
    return replace(course, moving=None, limp=False, waited_s=0.0, said="")


def go_back(course: Course, tendons: Sequence[TendonState], speed: float, dt: float) -> tuple[Course, bool]:
    """One cycle of the way back, then the torque as it was; whether that is done.

    Args:
        course: made by `back`, or what this returned.
        tendons: as they are now.
        speed: m/s.
        dt: s since the last cycle.
    """
    if course.limp:
        waited = course.waited_s + dt
        return replace(course, waited_s=waited), waited > _TORQUE_S or not any(t.torque for t in tendons)
    moving = course.moving or Moving(Move((0.0,) * len(course.goal), speed), course.goal)
    moving = moving.on(dt)
    there = moving.gone >= moving.way and moving.rested_s > _REST_S
    return replace(course, moving=moving, goal=moving.goal, limp=there and not course.held), there and course.held


class _Memo:
    """The newest generator, so that it need not be run again from its beginning for every answer."""

    def __init__(self) -> None:
        self.setup: Setup | None = None
        self.answers: tuple[Any, ...] = ()
        self.steps: Procedure[tuple[Zero, ...]] | None = None
        self.action: Action | tuple[Zero, ...] | None = None

    def knows(self, setup: Setup, answers: tuple[Any, ...]) -> bool:
        """Whether the generator has been given these very answers."""
        same = self.setup is setup and len(self.answers) == len(answers)
        return same and all(a is b for a, b in zip(self.answers, answers, strict=True))

    def take(self, setup: Setup, answers: tuple[Any, ...]) -> None:
        """Bring the generator to where it stands after these answers."""
        if self.steps is None or not answers or not self.knows(setup, answers[:-1]):
            self.setup, self.answers, self.steps = setup, (), procedure(setup)
            self._advance(None)
        for answer in answers[len(self.answers) :]:
            self._advance(answer)
            self.answers = (*self.answers, answer)

    def _advance(self, answer: Any) -> None:
        if self.steps is None:
            return
        steps, self.steps = self.steps, None  # one that raises is at its end
        try:
            self.action = steps.send(answer)
            self.steps = steps
        except StopIteration as end:
            self.action = end.value


_memo = _Memo()


def _action_after(setup: Setup, answers: tuple[Any, ...]) -> Action | tuple[Zero, ...]:
    """What the procedure asks for after these answers, or its result. The same for the same arguments, always.

    Raises:
        Refused: the procedure cannot go on.
    """
    if _memo.action is None or not _memo.knows(setup, answers):
        _memo.action = None
        _memo.take(setup, answers)
    if _memo.action is None:
        raise Refused("the procedure has no next step")
    return _memo.action
