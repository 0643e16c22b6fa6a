"""Simulated time jumps, and the ticker keeps its phase and never bursts."""

import asyncio
import signal
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

import pytest

from arm_companion.clock import Clock, run_real_time, run_simulated, ticks

Run = Callable[[Coroutine[Any, Any, None]], None]
both = pytest.mark.parametrize("run", [run_real_time, run_simulated])


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Ctrl-C as in a terminal: what a shell starts in the background inherits that it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_hour_of_waiting_takes_no_time_and_ends_at_the_hour() -> None:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        start = loop.time()
        await asyncio.sleep(3600.0)
        return loop.time() - start

    assert run_simulated(main()) == pytest.approx(3600.0, abs=1e-6)


def test_tasks_run_in_the_order_of_their_due_times() -> None:
    seen: list[str] = []

    async def note(after: float, name: str) -> None:
        await asyncio.sleep(after)
        seen.append(name)

    async def main() -> None:
        await asyncio.gather(note(0.3, "c"), note(0.1, "a"), note(0.2, "b"))

    run_simulated(main())
    assert seen == ["a", "b", "c"]


def test_a_wait_that_nothing_will_end_is_an_error_and_not_a_hang() -> None:
    async def main() -> None:
        await asyncio.Event().wait()

    with pytest.raises(RuntimeError, match="no timer"):
        run_simulated(main())


def test_ticks_come_at_fixed_phase() -> None:
    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        start = loop.time()
        times = []
        async for tick in ticks(0.01):
            times.append(tick.due - start)
            await asyncio.sleep(0.004)
            if len(times) == 50:
                break
        return times

    assert run_simulated(main()) == pytest.approx([0.01 * i for i in range(50)], abs=1e-9)


def test_a_stall_skips_ticks_keeps_the_phase_and_counts_what_was_missed() -> None:
    async def main() -> list[tuple[float, int]]:
        start = asyncio.get_running_loop().time()
        seen = []
        async for tick in ticks(0.01):
            seen.append((round(tick.now - start, 6), tick.missed))
            if len(seen) == 3:
                await asyncio.sleep(0.035)
            if len(seen) == 6:
                break
        return seen

    assert run_simulated(main()) == [(0.0, 0), (0.01, 0), (0.02, 0), (0.06, 3), (0.07, 0), (0.08, 0)]


def test_unix_stamps_do_not_follow_a_step_of_the_wall_clock() -> None:
    async def main() -> float:
        clock = Clock(asyncio.get_running_loop(), 1_000.0)
        first = clock.unix(clock.now())
        await asyncio.sleep(2.5)
        return clock.unix(clock.now()) - first

    assert run_simulated(main()) == pytest.approx(2.5)


@both
@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_cancels_and_pressed_again_does_not_cut_the_orderly_end_short(run: Run) -> None:
    ended = []

    async def main() -> None:
        signal.raise_signal(signal.SIGINT)
        try:
            await asyncio.sleep(60.0)
        finally:
            for _ in range(2):
                signal.raise_signal(signal.SIGINT)
                await asyncio.sleep(0.01)
            ended.append("in order")

    with pytest.raises(KeyboardInterrupt):
        run(main())
    assert ended == ["in order"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@both
def test_what_is_cancelled_otherwise_is_no_ctrl_c(run: Run) -> None:
    async def main() -> None:
        raise asyncio.CancelledError

    with pytest.raises(asyncio.CancelledError):
        run(main())


@both
def test_a_signal_that_somebody_else_takes_is_left_to_them(run: Run) -> None:
    taken = []

    async def main() -> None:
        signal.raise_signal(signal.SIGINT)
        await asyncio.sleep(0.01)

    before = signal.signal(signal.SIGINT, lambda number, _: taken.append(number))
    try:
        run(main())
    finally:
        signal.signal(signal.SIGINT, before)
    assert taken == [signal.SIGINT]
