"""What the operator does in scenarios about what goes wrong: orders that are taken back, and gusts."""

import asyncio
import contextlib
from functools import partial

from arm_companion.protocol.dialect import mav
from arm_companion.sim.scenario import Operator, ScenarioFailed

ABORTED_IN = ("APPROACH", "REACH", "CONTACT", "WRAP", "VERIFY", "PERCHED")
"""States of a perch in which the operator aborts, one perch each."""

_INSIDE_S = 0.5  # of the state, before the abort
_TOLD_S = 0.3  # a state is told ten times a second
_AWAY_S = 60.0
_ATTEMPTS = 3
_STAY_S = 20.0


async def fly_aborts(operator: Operator) -> str:
    """One perch after the other, each aborted in another state. Returns why it failed, or an empty string."""
    return await operator.fly(*(partial(_abort_in, operator, state) for state in ABORTED_IN))


async def fly_one_abort(operator: Operator) -> str:
    """A single one of them, drawn by the seed, for trials."""
    state = ABORTED_IN[operator.config.sim.seed % len(ABORTED_IN)]
    return await operator.fly(partial(_abort_in, operator, state))


async def fly_in_gusts(operator: Operator) -> str:
    """A perch in gusts, which may take three attempts, and a while on the bar in them."""
    return await operator.fly(partial(_perch_at_last, operator), partial(_stay, operator), operator.release)


async def _abort_in(operator: Operator, state: str) -> None:
    if operator.state == "STOWED":
        await operator.ready()
    operator.say(f"PERCH, to be aborted in {state}")
    perch = asyncio.create_task(operator.perch())
    try:
        await operator.wait(lambda: operator.state == state or perch.done(), 150.0, f"never in {state}")
        # an abort of what has ended by itself shows nothing; the order's answer may come before the state is told
        await operator.wait(lambda: operator.state == state, _TOLD_S, f"the perch ended before {state}")
        await asyncio.sleep(_INSIDE_S)
        if operator.state not in ABORTED_IN:
            raise ScenarioFailed(f"the perch did not last until its abort in {state}")
        operator.say("ABORT")
        start = asyncio.get_running_loop().time()
        await operator.order(mav.MAV_CMD_ARM_ABORT, "ABORT", 10.0)
        await operator.wait(lambda: operator.state == "STOWED", _AWAY_S, f"after the abort the arm stays {state}")
        operator.mark(state, start)
    finally:
        perch.cancel()
        with contextlib.suppress(ScenarioFailed, TimeoutError, asyncio.CancelledError):
            await perch


async def _perch_at_last(operator: Operator) -> None:
    """What pilots do: a vehicle that a gust blew off the bar tries again."""
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            await operator.perch()
        except ScenarioFailed as failed:
            if attempt == _ATTEMPTS:
                raise ScenarioFailed(f"{_ATTEMPTS} attempts failed, the last: {failed}") from None
            operator.say(f"attempt {attempt} failed: {failed}")
            await operator.wait(lambda: operator.state in ("STOWED", "READY"), _AWAY_S, "the arm does not come back")
            await operator.ready()
        else:
            return


async def _stay(operator: Operator) -> None:
    await asyncio.sleep(_STAY_S)
    if operator.state != "PERCHED":
        raise ScenarioFailed(f"the perch ended by itself in {operator.state}")
