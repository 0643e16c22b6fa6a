"""Time: one clock for the whole daemon, a ticker that never bursts, and a loop on which time is simulated.

The event loop is the clock. In flight it is the monotonic clock of the machine; in simulated time it stands
still while there is work to do and jumps to the next timer when there is none, so that the same program runs
as fast as the processor allows and the same way every time.
"""

import asyncio
import selectors
import signal
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from types import FrameType
from typing import Any, TypeVar

T = TypeVar("T")

SIMULATED_EPOCH_S = 1_767_225_600.0
"""Unix time at which every simulated run starts (2026-01-01 UTC)."""


class Clock:
    """Seconds on the running loop, and the Unix time that belongs to them.

    The offset to Unix time is taken once: a step of the system's wall clock never moves a time stamp
    relative to another.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, unix_now_s: float, wall: Callable[[], float] | None = None
    ) -> None:
        """Tie `loop` to Unix time.

        Args:
            loop: the running one.
            unix_now_s: Unix time now.
            wall: tells it at any later time, by the machine's own clock; None: there is no other than this one.
        """
        self._loop = loop
        self._unix_offset_s = unix_now_s - loop.time()
        self._wall = wall

    def now(self) -> float:
        """Seconds, monotonic, from an arbitrary start."""
        return self._loop.time()

    def unix(self, t: float) -> float:
        """Unix time in seconds of the monotonic instant `t`."""
        return t + self._unix_offset_s

    @property
    def wall_set_by_s(self) -> float:
        """By how much the machine's own clock has been set since the start, s."""
        return 0.0 if self._wall is None else self._wall() - self.unix(self.now())


@dataclass(frozen=True, slots=True)
class Tick:
    """One tick: when it was due, when it came, and how many before it were missed."""

    due: float
    now: float
    missed: int

    @property
    def late_s(self) -> float:
        """How long after its due time the tick came."""
        return self.now - self.due


async def ticks(period_s: float) -> AsyncIterator[Tick]:
    """Yield at fixed phase, every `period_s`. Ticks that were slept through are skipped and counted.

    After a stall the next tick comes at the next due time of the original phase, never in a burst.
    """
    loop = asyncio.get_running_loop()
    due = loop.time()
    missed = 0
    while True:
        wait = due - loop.time()
        await asyncio.sleep(max(wait, 0.0))
        now = loop.time()
        yield Tick(due, now, missed)
        behind = int((loop.time() - due) / period_s)
        missed = behind
        due += period_s * (behind + 1)


def precise_loop() -> asyncio.SelectorEventLoop:
    """A loop in real time whose timers are good to some 0.1 ms.

    The default loop on Linux waits with epoll, and Python rounds every such wait up to a whole millisecond.
    """
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


class _JumpingSelector(selectors.DefaultSelector):
    """A selector that, instead of waiting for a timer, moves the clock to it."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready and timeout is None:
            raise RuntimeError("simulated time: every task waits for something that no timer will bring")
        if not ready and timeout:
            self.now += timeout
        return ready


class SimulatedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time jumps to the next timer when nothing is ready to run."""

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Simulated seconds since the loop was made."""
        return self._jumping.now


def run_simulated(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a fresh loop in simulated time.

    Raises:
        KeyboardInterrupt: Ctrl-C ended it; see `run_real_time`.
        RuntimeError: when all tasks wait and no timer is set, which in real time would hang for ever.
    """
    return _run(main, SimulatedLoop)


def run_real_time(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a fresh `precise_loop`.

    Ctrl-C cancels it. Pressed again while it winds up, Ctrl-C does nothing more: whoever is impatient, and whatever
    sends the signal to a process and to its group, would otherwise cut its orderly end short.

    Raises:
        KeyboardInterrupt: Ctrl-C ended it.
    """
    return _run(main, precise_loop)


def _run(main: Coroutine[Any, Any, T], make_loop: Callable[[], asyncio.AbstractEventLoop]) -> T:
    in_main_thread = threading.current_thread() is threading.main_thread()  # no other can take signals
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        with asyncio.Runner(loop_factory=make_loop) as runner:
            return runner.run(main)
    task: asyncio.Task[T] | None = None
    presses = 0

    async def whole() -> T:
        nonlocal task
        task = asyncio.current_task()
        if presses:  # while the loop was being made
            main.close()
            raise asyncio.CancelledError
        return await main

    def press(_number: int, _frame: FrameType | None) -> None:
        nonlocal presses
        presses += 1
        if presses == 1 and task is not None:
            task.get_loop().call_soon_threadsafe(task.cancel)

    signal.signal(signal.SIGINT, press)
    try:
        with asyncio.Runner(loop_factory=make_loop) as runner:
            return runner.run(whole())
    except asyncio.CancelledError:
        if presses:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def unix_now() -> float:
    """The wall clock, read at start to tie the loop's time to Unix time, and later to see whether it has been set."""
    return time.time()  # noqa: TID251 - the one place
