"""`arm-companion ground` that orders: ready, perch, ... jog and the parameters."""

import argparse
import asyncio
import contextlib
import dataclasses
import math
import re
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any, Final

from arm_companion.cli.ground import DONE, FAILED, INTERRUPTED, Action, say, tell
from arm_companion.clock import ticks
from arm_companion.errors import ArmError
from arm_companion.ground.arm import Arm
from arm_companion.ground.channel import ArmSilent
from arm_companion.ground.commands import RESULTS, CommandFailed
from arm_companion.ground.jog import HELP, PERIOD_S, WATCHDOG_S, Jog, keyboard
from arm_companion.ground.parameters import Parameter
from arm_companion.ground.reports import Status
from arm_companion.ground.targets import tell_bar, tell_object
from arm_companion.ground.texts import Text
from arm_companion.protocol.dialect import mav

_FOLLOWS_S: Final = 2.0
_STILL: Final = math.radians(1.0)
_STATUS_S: Final = 0.3
_ANSWER: Final = re.compile(f"[A-Z_]+ ({'|'.join(RESULTS.values())}): ")
_ANSWER_S: Final = 1.0
"""A command's end follows the sentence that tells why, or the other way round, by less than this."""
_WHILE_HEARD: Final = """It lasts while the arm hears this station, which ends with this program: without another one
of the same ids, such as `arm-companion ground watch`, it is lost after mavlink.control_timeout_s (10 s)."""
_LEAVE: Final = 3
"""So many times Ctrl-C leaves an order that is under way."""


@contextlib.asynccontextmanager
async def interrupts() -> "AsyncIterator[asyncio.Queue[int]]":
    """Each Ctrl-C as an entry of a queue, instead of an exception."""
    queue: asyncio.Queue[int] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGINT, queue.put_nowait, signal.SIGINT)
    try:
        yield queue
    finally:
        loop.remove_signal_handler(signal.SIGINT)


async def follow(arguments: argparse.Namespace, arm: Arm, name: str, work: Awaitable[None]) -> int:
    """Follow an order to its end, and say what comes of it.

    Ctrl-C does not touch the arm: it only says how to. The second one aborts, as whoever presses it twice wants the arm
    to stop and not this program. The third one leaves.
    """
    loop = asyncio.get_running_loop()
    started = loop.time()
    task = asyncio.ensure_future(work)
    listener = asyncio.create_task(_repeat_texts(arguments, arm))
    try:
        async with interrupts() as queue:
            aborted = await _until_done_or_left(arguments, arm, name, task, queue)
    finally:
        listener.cancel()
        task.cancel()  # does nothing to one that is done
        await asyncio.wait({task})
    seconds = round(loop.time() - started, 3)
    await _fresh_status(arm)
    state = arm.status.state if arm.status else ""
    facts = {"action": arguments.action, "state": state, "seconds": seconds}
    if task.cancelled():
        say(arguments, f"left: the arm carries on ({state or 'state unknown'}). To abort: arm-companion ground abort")
        tell(arguments, result="left", reason="", **facts)
        return INTERRUPTED
    try:
        task.result()
    except CommandFailed as failed:
        print(f"arm-companion ground: {failed}", file=sys.stderr)
        tell(arguments, result=failed.result, reason=failed.reason, **facts)
        return INTERRUPTED if aborted else FAILED
    say(arguments, f"{name} done in {seconds:.1f} s" + (f", state {state}" if state else ""))
    tell(arguments, result="accepted", reason="", **facts)
    return DONE


async def _fresh_status(arm: Arm) -> None:
    """Wait a moment for a status from after the answer: the newest may still tell of the state before."""
    name = Status.MESSAGE
    before = arm.channel.counters.get(name, 0)
    with contextlib.suppress(ArmSilent):
        await arm.channel.wait_for(lambda: arm.channel.counters.get(name, 0) > before, _STATUS_S, "")


async def _until_done_or_left(
    arguments: argparse.Namespace, arm: Arm, name: str, task: "asyncio.Future[None]", interrupted: "asyncio.Queue[int]"
) -> bool:
    """Wait for the order, or for the Ctrl-C that leaves; returns whether one has aborted it."""
    presses = 0
    abort: asyncio.Task[None] | None = None
    while not task.done() and presses < _LEAVE:
        press = asyncio.create_task(interrupted.get())
        either: set[asyncio.Future[Any]] = {task, press}
        await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        if not press.done():
            press.cancel()
            break
        presses += 1
        if presses == 1:
            say(arguments, f"{name} goes on. Ctrl-C again: abort. A third time: leave, and the arm carries on.")
        elif presses < _LEAVE:
            say(arguments, "aborting")
            abort = asyncio.create_task(_abort(arguments, arm))
    if abort is not None:
        if presses >= _LEAVE:
            abort.cancel()
        await asyncio.wait({abort})
    return abort is not None


async def _abort(arguments: argparse.Namespace, arm: Arm) -> None:
    try:
        await arm.abort()
    except ArmError as error:
        say(arguments, f"ABORT: {error}")


async def _repeat_texts(arguments: argparse.Namespace, arm: Arm) -> None:
    async for text in arm.stream(Text, patient=True):
        if _ANSWER.match(text.text):  # an order of ours ends with it, and then says so itself
            await asyncio.sleep(_ANSWER_S)
        say(arguments, f"  {text.severity}: {text.text}")


def _order(name: str) -> Action:
    async def action(arguments: argparse.Namespace, arm: Arm) -> int:
        def progress(per_cent: int | None) -> None:
            say(arguments, f"  {name.upper()} in progress" + ("" if per_cent is None else f", {per_cent} %"))

        if name == "abort":
            return await follow(arguments, arm, "ABORT", arm.abort(timeout=arguments.timeout))
        if name == "perch" and arguments.bar is not None:
            heading = math.radians(arguments.bar_axis_deg)
            axis = (math.cos(heading), math.sin(heading), 0.0)
            north, east, down = arguments.bar
            await tell_bar(arm, (north, east, down), axis, arguments.bar_radius)
        if name == "perch" and arguments.hang:
            hang = arm.perch(mav.ARM_PERCH_KIND_HANG, progress=progress, timeout=arguments.timeout)
            return await follow(arguments, arm, "PERCH", hang)
        if name == "grasp" and arguments.object is not None:
            heading = math.radians(arguments.object_axis_deg)
            north, east, down = arguments.object
            await tell_object(arm, (north, east, down), heading, arguments.object_radius)
        method: Callable[..., Awaitable[None]] = getattr(arm, name)
        return await follow(arguments, arm, name.upper(), method(progress=progress, timeout=arguments.timeout))

    return action


async def _jog(arguments: argparse.Namespace, arm: Arm) -> int:
    if arguments.vehicle is not None:
        return await follow(arguments, arm, "JOG", arm.jog_vehicle(*arguments.vehicle))
    if arguments.theta_deg is not None:
        theta, delta = math.radians(arguments.theta_deg), math.radians(arguments.delta_deg)
        return await follow(arguments, arm, "JOG", arm.jog_bend(theta, delta))
    status = await arm.first(Status)
    if status.state != "READY":
        print(f"arm-companion ground: jogging needs state READY, the arm is in {status.state}", file=sys.stderr)
        return FAILED
    return await _jog_by_keys(arguments, arm, status)


async def _jog_by_keys(arguments: argparse.Namespace, arm: Arm, status: Status) -> int:
    theta, delta = (value if math.isfinite(value) else 0.0 for value in (status.theta, status.delta))
    jog = Jog(theta, delta)
    moved_at, warned = math.inf, False
    say(arguments, HELP)
    listener = asyncio.create_task(_repeat_texts(arguments, arm))
    try:
        async with interrupts() as stop, keyboard() as keys:
            async for tick in ticks(PERIOD_S):
                now = arm.status or status
                while not keys.empty():
                    key = keys.get_nowait()
                    if key == "q":
                        stop.put_nowait(signal.SIGINT)
                    if (after := jog.press(key, now.theta, now.delta)) != jog:
                        jog, moved_at = after, tick.now
                if not stop.empty() or not (now.state == "READY" or now.behaviour == "jog"):
                    break
                await arm.send_set_point(jog.theta, jog.delta, WATCHDOG_S)
                _show_jog(arguments, jog, now)
                if not warned and tick.now - moved_at > _FOLLOWS_S:
                    warned = True
                    if abs(now.goal_theta - theta) < _STILL and abs(now.theta - theta) < _STILL < abs(
                        jog.theta - theta
                    ):
                        say(arguments, "\nthe arm does not follow: it takes no set-points now, or not ours")
    finally:
        listener.cancel()
    state = arm.status.state if arm.status else "unknown"
    say(arguments, f"\njogging ended: the arm holds where it is, state {state}")
    return DONE


def _show_jog(arguments: argparse.Namespace, jog: Jog, now: Status) -> None:
    if arguments.json:
        arm_theta, arm_delta = (value if math.isfinite(value) else None for value in (now.theta, now.delta))
        tell(arguments, theta=jog.theta, delta=jog.delta, arm_theta=arm_theta, arm_delta=arm_delta)
        return
    asked = f"asked {math.degrees(jog.theta):6.1f} deg in {math.degrees(jog.delta):6.1f}"
    is_at = f"at {math.degrees(now.theta):6.1f} in {math.degrees(now.delta):6.1f}"
    print(f"\r{asked}   {is_at}   step {math.degrees(jog.step_rad):.1f} ", end="", flush=True)


async def _clear(arguments: argparse.Namespace, arm: Arm) -> int:
    work = arm.order(mav.MAV_CMD_ARM_CLEAR_ERRORS, timeout=arguments.timeout)
    return await follow(arguments, arm, "CLEAR_ERRORS", work)


async def _reach(arguments: argparse.Namespace, arm: Arm) -> int:
    def progress(per_cent: int | None) -> None:
        say(arguments, "  REACH in progress" + ("" if per_cent is None else f", {per_cent} %"))

    work = arm.reach(
        arguments.north,
        arguments.east,
        arguments.down,
        arm_only=arguments.arm_only,
        progress=progress,
        timeout=arguments.timeout,
    )
    return await follow(arguments, arm, "REACH", work)


async def _control(arguments: argparse.Namespace, arm: Arm) -> int:
    work = (
        arm.release_control() if arguments.verb == "release" else arm.take_control(force=arguments.verb == "take-over")
    )
    code = await follow(arguments, arm, "CONTROL", work)
    if code == DONE and arguments.verb != "release":
        say(arguments, _WHILE_HEARD)
    return code


async def _params(arguments: argparse.Namespace, arm: Arm) -> int:
    if arguments.verb == "list":
        found = await arm.parameters.read_all()
        tell(arguments, parameters=[_plain(p) for p in found])
        for parameter in () if arguments.json else found:
            print(_line(parameter))
        return DONE
    if arguments.verb == "get":
        parameter = await arm.parameters.read(arguments.name)
    else:
        parameter = await arm.parameters.write(arguments.name, arguments.value)
    if arguments.json:
        tell(arguments, **_plain(parameter))
    else:
        print(_line(parameter))
    return DONE


def _plain(parameter: Parameter) -> dict[str, object]:
    fields = dataclasses.asdict(parameter)
    return {**fields, "value": parameter.value if math.isfinite(parameter.value) else None}


def _line(parameter: Parameter) -> str:
    digits = 7 if parameter.kind == "real32" else 10  # what a float of 32 bits holds, and a whole number
    value = f"{parameter.value:.{digits}g}" if math.isfinite(parameter.value) else "?"
    return f"{parameter.name:<16}  {value:>14}  {parameter.kind}"


ACTIONS: Final[dict[str, Action]] = {
    **{name: _order(name) for name in ("ready", "perch", "grasp", "release", "stow", "abort", "calibrate")},
    "clear": _clear,
    "jog": _jog,
    "reach": _reach,
    "control": _control,
    "params": _params,
}
