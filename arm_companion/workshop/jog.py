"""Jogging from the keyboard, without the keyboard: keys to a bend that moves no faster than it may, and the screen."""

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from arm_companion.mission.facts import TendonState
from arm_companion.mission.motion import ramp

STEPS_RAD = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
_FIRST_STEP = 2
_ESCAPE = b"\x1b"


class Key(enum.Enum):
    """What a person can press."""

    AHEAD = "towards +x of the base"
    BACK = "towards -x"
    RIGHT = "towards +y"
    LEFT = "towards -y"
    COARSER = "larger step"
    FINER = "smaller step"
    STOP = "stop where it is"
    RELAX = "slowly straight, at pretension"
    QUIT = "end; the servos hold"


_KEYS = {
    b"w": Key.AHEAD,
    b"s": Key.BACK,
    b"d": Key.RIGHT,
    b"a": Key.LEFT,
    b"+": Key.COARSER,
    b"=": Key.COARSER,
    b"-": Key.FINER,
    b" ": Key.STOP,
    b"r": Key.RELAX,
    b"q": Key.QUIT,
}
_ARROWS = {b"A": Key.AHEAD, b"B": Key.BACK, b"C": Key.RIGHT, b"D": Key.LEFT}
_MOVES = {Key.AHEAD: (1.0, 0.0), Key.BACK: (-1.0, 0.0), Key.RIGHT: (0.0, 1.0), Key.LEFT: (0.0, -1.0)}


@dataclass(frozen=True, slots=True)
class Jog:
    """Where the bend is and where it goes.

    Attributes:
        bend: commanded now (2,), rad.
        goal: (2,), rad.
        step: index into `STEPS_RAD`.
        limit: largest bend, rad.
    """

    bend: tuple[float, float]
    goal: tuple[float, float]
    limit: float
    step: int = _FIRST_STEP

    @property
    def step_rad(self) -> float:
        """By which one key moves the goal."""
        return STEPS_RAD[self.step]


def decode(typed: bytes) -> tuple[list[Key], bytes]:
    """Keys in what a terminal sent, and what may be the beginning of another one; unknown ones are left out."""
    keys: list[Key] = []
    while typed:
        if typed[:1] != _ESCAPE:
            if (key := _KEYS.get(typed[:1].lower())) is not None:
                keys.append(key)
            typed = typed[1:]
        elif len(typed) < 3 and typed[1:2] in {b"", b"[", b"O"}:
            return keys, typed
        elif typed[1:2] in {b"[", b"O"}:
            end = 2
            while end < len(typed) and not 0x40 <= typed[end] <= 0x7E:  # parameters of a longer sequence
                end += 1
            if end == len(typed):
                return keys, typed
            if end == 2 and (key := _ARROWS.get(typed[2:3])) is not None:
                keys.append(key)
            typed = typed[end + 1 :]
        else:
            typed = typed[1:]
    return keys, b""


def press(jog: Jog, key: Key) -> Jog:
    """The jog after a key; QUIT changes nothing."""
    if key in _MOVES:
        x, y = _MOVES[key]
        goal = (jog.goal[0] + x * jog.step_rad, jog.goal[1] + y * jog.step_rad)
        size = math.hypot(*goal)
        if size > jog.limit:
            goal = (goal[0] * jog.limit / size, goal[1] * jog.limit / size)
        return replace(jog, goal=goal)
    match key:
        case Key.COARSER:
            return replace(jog, step=min(jog.step + 1, len(STEPS_RAD) - 1))
        case Key.FINER:
            return replace(jog, step=max(jog.step - 1, 0))
        case Key.STOP:
            return replace(jog, goal=jog.bend)
        case Key.RELAX:
            return replace(jog, goal=(0.0, 0.0))
    return jog


def advance(jog: Jog, speed: float, dt: float) -> Jog:
    """The bend a little later, at most `speed` rad/s on."""
    way = (jog.goal[0] - jog.bend[0], jog.goal[1] - jog.bend[1])
    distance = math.hypot(*way)
    gone = ramp(0.0, distance, speed, dt)
    if gone >= distance:
        return replace(jog, bend=jog.goal)
    share = gone / distance
    return replace(jog, bend=(jog.bend[0] + share * way[0], jog.bend[1] + share * way[1]))


def screen(
    jog: Jog,
    tendons: Sequence[TendonState],
    limited: Sequence[bool],
    bend: tuple[float, float],
    tip: tuple[float, float, float] | None,
    note: str,
) -> str:
    """What the person sees, line by line.

    Args:
        jog: what is asked for.
        tendons: what is measured.
        limited: for each tendon whether a limit holds it back.
        bend: that the measured displacements stand for (2,), rad.
        tip: of the hanging arm (3,), m, base axes; None when the model has none.
        note: a line of its own.
    """
    lines = ["tendon   pull    tension     load   temp   volts"]
    for i, (t, held) in enumerate(zip(tendons, limited, strict=True)):
        state = "silent" if t.silent else "LIMITED" if held else "" if t.torque else "torque off"
        lines.append(
            f"  {i + 1}   {1e3 * t.pull:+7.1f} mm {t.tension:5.1f} +-{t.tension_sigma:4.1f} N {100 * t.load:+5.0f} % "
            f"{t.temperature:4.0f} C {t.voltage:5.1f} V  {state}"
        )
    where = "not known"
    if tip is not None:
        where = "  ".join(f"{axis} {1e3 * v:+.0f} mm" for axis, v in zip("xyz", tip, strict=True))
    step = f"step {math.degrees(jog.step_rad):.1f} deg"
    lines += [
        f"bend     theta {_degrees(math.hypot(*bend))}  delta {_degrees(_delta(bend))}",
        f"goal     theta {_degrees(math.hypot(*jog.goal))}  delta {_degrees(_delta(jog.goal))}  {step}",
        f"tip      {where}",
        "arrows or wasd bend, + - step, space stop, r relax, q quit",
        note,
    ]
    return "\n".join(lines)


def _delta(bend: tuple[float, float]) -> float:
    return math.atan2(bend[1], bend[0])


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):+7.1f} deg"
