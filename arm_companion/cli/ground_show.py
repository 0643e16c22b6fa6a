"""`arm-companion ground` that only listens: status, watch, record, plot."""

import argparse
import asyncio
import contextlib
import json
import math
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Final

from arm_companion.cli.common import in_words
from arm_companion.cli.ground import DONE, FAILED, Action, say, tell
from arm_companion.cli.ground_orders import interrupts
from arm_companion.clock import Clock, ticks, unix_now
from arm_companion.errors import ArmError
from arm_companion.ground.arm import Arm
from arm_companion.ground.channel import ArmSilent
from arm_companion.ground.recording import Entry, Recording, format_of, read_jsonl
from arm_companion.ground.reports import Status, Tendons, Wrench, as_json
from arm_companion.ground.texts import Text

_FRAMES_HZ: Final = 5.0
_LINE_S: Final = 1.0
_FIRST_S: Final = 3.0


async def _status(arguments: argparse.Namespace, arm: Arm) -> int:
    missing = []
    kinds: tuple[type[Status | Tendons | Wrench], ...] = (Status, Tendons, Wrench)
    for kind in kinds:
        try:
            await arm.first(kind, arguments.timeout or _FIRST_S)
        except ArmSilent:
            missing.append(kind.MESSAGE)
    reports = {"status": arm.status, "tendons": arm.tendons, "wrench": arm.wrench, "payload": arm.payload}
    facts: dict[str, Any] = {"system": arm.system, "component": arm.channel.component, "way": arm.way}
    facts |= {name: None if report is None else as_json(report) for name, report in reports.items()}
    tell(arguments, **facts)
    if not arguments.json:
        _print_status(arguments, arm)
    if missing:
        print(f"arm-companion ground: heard, but no {', '.join(missing)}{_hint(arm)}", file=sys.stderr)
    return FAILED if arm.status is None else DONE


def _hint(arm: Arm) -> str:
    if arm.channel.behind_autopilot:
        return ": through an autopilot they come inside TUNNEL only; is its forwarding on, and tunnelling at the arm?"
    return ""


def _print_status(arguments: argparse.Namespace, arm: Arm) -> None:
    try:
        from rich.console import Console  # noqa: PLC0415 - words do without

        from arm_companion.ground.screen import Rates, screen  # noqa: PLC0415
    except ImportError:
        print(json.dumps(None if arm.status is None else as_json(arm.status), indent=2))
        return
    Console().print(screen(arm, arguments.connect, Rates()))


async def _watch(arguments: argparse.Namespace, arm: Arm) -> int:
    if arguments.json:
        async for _, entry in _heard(arguments, arm):
            print(json.dumps(_entry(entry)), flush=True)
        return DONE
    await (_watch_screen if sys.stdout.isatty() else _watch_lines)(arguments, arm)
    return DONE


def _entry(entry: Entry) -> dict[str, Any]:
    if isinstance(entry, Text):
        return {"message": "STATUSTEXT", "severity": entry.severity, "text": entry.text}
    return as_json(entry)


async def _watch_screen(arguments: argparse.Namespace, arm: Arm) -> None:
    from rich.live import Live  # noqa: PLC0415 - only this needs it

    from arm_companion.ground.screen import Rates, screen  # noqa: PLC0415

    rates = Rates()
    async with interrupts() as stop:
        with Live(screen(arm, arguments.connect, rates), auto_refresh=False, screen=True) as live:
            async for tick in _frames(arguments, 1.0 / _FRAMES_HZ):
                if not stop.empty():
                    return
                rates.take(tick, arm.channel.counters)
                live.update(screen(arm, arguments.connect, rates), refresh=True)


async def _watch_lines(arguments: argparse.Namespace, arm: Arm) -> None:
    from arm_companion.ground.screen import summary  # noqa: PLC0415 - needs rich

    texts = asyncio.create_task(_print_texts(arm))
    try:
        async with interrupts() as stop:
            async for _ in _frames(arguments, _LINE_S):
                if not stop.empty():
                    return
                print(summary(arm), flush=True)
    finally:
        texts.cancel()


async def _print_texts(arm: Arm) -> None:
    async for text in arm.stream(Text, patient=True):
        print(f"{text.severity}: {text.text}", flush=True)


async def _frames(arguments: argparse.Namespace, period_s: float) -> AsyncIterator[float]:
    end = asyncio.get_running_loop().time() + (arguments.seconds or math.inf)
    async for tick in ticks(period_s):
        if tick.now >= end:
            return
        yield tick.now


async def _heard(arguments: argparse.Namespace, arm: Arm) -> AsyncIterator[tuple[float, Entry]]:
    """Reports with the Unix time at which they came, for --seconds or until Ctrl-C."""
    clock = Clock(asyncio.get_running_loop(), unix_now())
    queue: asyncio.Queue[Entry | None] = asyncio.Queue()

    async def listen() -> None:
        async for report in arm.stream(patient=True):
            queue.put_nowait(report)

    async def stop() -> None:
        async with interrupts() as pressed:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(arguments.seconds):
                    await pressed.get()
        queue.put_nowait(None)

    tasks = [asyncio.create_task(listen()), asyncio.create_task(stop())]
    try:
        while (entry := await queue.get()) is not None:
            yield clock.unix(clock.now()), entry
    finally:
        for task in tasks:
            task.cancel()


async def _record(arguments: argparse.Namespace, arm: Arm) -> int:
    path = Path(arguments.output)
    path.parent.mkdir(parents=True, exist_ok=True)
    say(arguments, f"recording to {path}" + ("" if arguments.seconds else "; Ctrl-C ends"))
    with path.open("w", encoding="utf-8", newline="") as stream:  # noqa: ASYNC230 - once, and nothing else waits
        recording = Recording(stream, format_of(path))
        async for received, entry in _heard(arguments, arm):
            recording.put(received, entry)
    say(arguments, f"{recording.written} reports in {path}")
    tell(arguments, action="record", result="accepted", file=str(path), reports=recording.written)
    return DONE if recording.written else FAILED


async def _plot(arguments: argparse.Namespace, arm: Arm) -> int:
    say(arguments, f"listening for {arguments.seconds:g} s")
    entries = [entry async for entry in _heard(arguments, arm)]
    return _draw(arguments, entries, f"arm {arm.system}/{arm.channel.component}")


def plot_record(arguments: argparse.Namespace) -> int:
    """Draw a file; needs no arm."""
    path = Path(arguments.record)
    if format_of(path) == "csv":
        print("arm-companion ground: plot reads records in JSON lines, not CSV", file=sys.stderr)
        return FAILED
    try:
        with path.open(encoding="utf-8") as stream:
            entries = list(read_jsonl(stream))
        return _draw(arguments, entries, path.name)
    except (ArmError, OSError, UnicodeDecodeError) as error:
        what = in_words(error) if isinstance(error, OSError) else f"{path}: {error}"
        print(f"arm-companion ground: {what}", file=sys.stderr)
        return FAILED


def _draw(arguments: argparse.Namespace, entries: list[tuple[float, Entry]], title: str) -> int:
    from arm_companion.ground.figure import draw  # noqa: PLC0415 - Matplotlib takes a second to import

    output = Path(arguments.output)
    draw(entries, output, title)
    say(arguments, f"{len(entries)} reports in {output}")
    tell(arguments, action="plot", result="accepted", file=str(output), reports=len(entries))
    return DONE


ACTIONS: Final[dict[str, Action]] = {"status": _status, "watch": _watch, "record": _record, "plot": _plot}
