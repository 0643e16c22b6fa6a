"""Jogging the free arm from a keyboard: keys to a set-point, streamed with a watchdog time.

A terminal tells when a key goes down, never when it comes up. So a key moves the set-point by one step, and the stream
is the dead man's switch: when program, terminal or link end, the arm's own watchdog makes it hold.
"""

import asyncio
import contextlib
import math
import os
import sys
import termios
import tty
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Final

PERIOD_S: Final = 0.1
WATCHDOG_S: Final = 0.5
"""The arm holds after this long without a set-point: four of them may get lost."""

LARGEST_THETA: Final = math.pi
HELP: Final = "up/down: bend   left/right: turn the plane   0: straight   space: hold here   + -: step   q: end"

_ARROWS: Final = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[C": "right", "\x1b[D": "left"}
_STEPS: Final = (math.radians(0.5), math.radians(1.0), math.radians(2.0), math.radians(5.0))


@dataclass(frozen=True, slots=True)
class Jog:
    """Where the arm is asked to be.

    Attributes:
        theta: bend, rad, from 0 to `LARGEST_THETA`.
        delta: bending plane about base z, rad, from -pi to pi.
        step: index of the step of one key.
    """

    theta: float
    delta: float
    step: int = 2

    @property
    def step_rad(self) -> float:
        """What one key moves, rad."""
        return _STEPS[self.step]

    def press(self, key: str, theta: float, delta: float) -> "Jog":
        """The set-point after a key.

        Args:
            key: `up`, `down`, `left`, `right`, `0`, ` `, `+` or `-`; others change nothing.
            theta: where the arm is now, rad, for holding it there; where it is not known, this changes nothing.
            delta: its plane, rad.
        """
        match key:
            case "up":
                return Jog(min(self.theta + self.step_rad, LARGEST_THETA), self.delta, self.step)
            case "down":
                return Jog(max(self.theta - self.step_rad, 0.0), self.delta, self.step)
            case "left" | "right":
                turn = self.step_rad if key == "left" else -self.step_rad
                return Jog(self.theta, math.remainder(self.delta + turn, math.tau), self.step)
            case "0":
                return Jog(0.0, self.delta, self.step)
            case " " if math.isfinite(theta) and math.isfinite(delta):
                return Jog(theta, delta, self.step)
            case "+" | "-":
                return Jog(self.theta, self.delta, min(max(self.step + (1 if key == "+" else -1), 0), len(_STEPS) - 1))
        return self


def split_keys(typed: str) -> list[str]:
    """Keys in what a terminal delivers at once; arrows come as escape sequences."""
    keys, at = [], 0
    while at < len(typed):
        arrow = _ARROWS.get(typed[at : at + 3])
        keys.append(arrow or typed[at])
        at += 3 if arrow else 1
    return keys


@contextlib.asynccontextmanager
async def keyboard() -> "AsyncIterator[asyncio.Queue[str]]":
    """Keys of standard input, one at a time and without echo; it must be a terminal. Ctrl-C stays a signal."""
    queue: asyncio.Queue[str] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def read() -> None:
        typed = os.read(descriptor, 64)
        if not typed:
            queue.put_nowait("q")
            loop.remove_reader(descriptor)
            return
        for key in split_keys(typed.decode("ascii", errors="replace")):
            queue.put_nowait(key)

    tty.setcbreak(descriptor)
    loop.add_reader(descriptor, read)
    try:
        yield queue
    finally:
        loop.remove_reader(descriptor)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
