"""What the guided commands share: the person at the terminal, signals, and the arm left safe at the end."""

import argparse
import asyncio
import contextlib
import os
import signal
import sys
import termios
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TypeVar

from arm_companion.clock import run_real_time
from arm_companion.config import Config
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.errors import ArmError, DeviceFault
from arm_companion.transport.urls import open_bus
from arm_companion.workshop.rig import Rig

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
T = TypeVar("T")


class RefusedError(ArmError):
    """The command cannot do what it is asked; the message is one line."""


class Terminal:
    """The person at standard input and output.

    Args:
        yes: answer everything that may be answered without a person.
    """

    def __init__(self, *, yes: bool = False) -> None:
        self._yes = yes
        self._typed = b""
        self._ended = False

    def say(self, text: str) -> None:
        """Print it."""
        print(text, flush=True)

    async def ask(self, text: str, *, sure: bool) -> str | None:
        """The next line typed, None at the end of input."""
        self._forget()
        print(f"\n{text}", flush=True)
        if self._yes and sure:
            return ""
        print("> ", end="", flush=True)
        return await self._line()

    def _forget(self) -> None:
        """Keys pressed before a question stands there are no answer to it: a second Enter would let a weight drop.

        What comes through a pipe may be ahead of the questions.
        """
        if not self._ended and sys.stdin.isatty():
            termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
            self._typed = b""

    async def _line(self) -> str | None:
        loop = asyncio.get_running_loop()
        descriptor = sys.stdin.fileno()
        while b"\n" not in self._typed and not self._ended:
            readable = asyncio.Event()
            loop.add_reader(descriptor, readable.set)
            try:
                await readable.wait()
            finally:
                loop.remove_reader(descriptor)
            try:
                data = os.read(descriptor, 1024)
            except OSError:  # the terminal hung up
                data = b""
            self._ended = not data
            self._typed += data
        if b"\n" not in self._typed:
            return None
        line, _, self._typed = self._typed.partition(b"\n")
        return line.decode(errors="replace")


def add_guide_arguments(parser: argparse.ArgumentParser) -> None:
    """`--yes` and `--directory`."""
    parser.add_argument("--yes", action="store_true", help="go on without waiting for Enter")
    parser.add_argument(
        "--directory", type=Path, metavar="DIR", help="state directory (default: calibration.directory of the file)"
    )


def state_directory(arguments: argparse.Namespace, config: Config) -> Path:
    """Where results go.

    Raises:
        RefusedError: neither the arguments nor the configuration say so, or nothing can be kept there: better now than
            after all has been measured.
    """
    named = arguments.directory or config.calibration.directory
    if not named:
        raise RefusedError("nowhere to keep the result: set calibration.directory in the configuration, or --directory")
    directory = Path(named)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RefusedError(f"{directory} cannot be written: {error.strerror}") from error
    if not os.access(directory, os.W_OK | os.X_OK):
        raise RefusedError(f"{directory} cannot be written by this user")
    return directory


def on_the_bench(config: Config, work: Callable[[Rig, ServoBus], Awaitable[T]]) -> T | None:
    """Run `work` with the servos of the arm; whatever ends it, the tendons go back and the torque off.

    The first Ctrl-C (or SIGTERM, SIGHUP) ends the work in this orderly way, a second one switches the torque off at
    once.

    Returns:
        What the work returned; None when a signal ended it.

    Raises:
        RefusedError: the bus or a servo does not do; one line for people.
        ArmError: what the work raised.
    """
    return run_real_time(_guarded(config, work))


async def _guarded(config: Config, work: Callable[[Rig, ServoBus], Awaitable[T]]) -> T | None:
    loop = asyncio.get_running_loop()
    bus = ServoBus(open_bus(config.servos.port, config.servos.baud), config.servos)
    rig = Rig(bus, config.servos, config.limits, config.arm.pulley_radius_m)
    task = asyncio.ensure_future(_started(rig, bus, work))
    easing: asyncio.Task[None] | None = None
    interrupted = False

    def interrupt() -> None:
        nonlocal interrupted
        if not interrupted:
            interrupted = True
            task.cancel()
        elif easing is not None:
            easing.cancel()  # its own end switches the torque off

    for number in _SIGNALS:
        loop.add_signal_handler(number, interrupt)
    result: T | None = None
    try:
        result = await task
    except* asyncio.CancelledError:
        if not interrupted:
            raise
        _tell("interrupted: back to where the tendons were, then torque off (Ctrl-C again: off at once)")
    except* DeviceFault as faults:
        raise RefusedError("; ".join(str(fault) for fault in _leaves(faults))) from faults
    except* ArmError as errors:
        raise RefusedError("; ".join(str(error) for error in _leaves(errors))) from errors
    finally:
        easing = asyncio.ensure_future(rig.make_safe())
        await _eased(easing)
        with contextlib.suppress(ExceptionGroup):
            await bus.stop(limp=False)
        for number in _SIGNALS:
            loop.remove_signal_handler(number)
    return result


async def _eased(easing: "asyncio.Task[None]") -> None:
    """Wait for the arm to be safe; say so when it may not be."""
    try:
        with contextlib.suppress(asyncio.CancelledError):
            await easing
    except* DeviceFault as faults:
        _tell("torque may still be on: " + "; ".join(str(fault) for fault in _leaves(faults)))


async def _started(rig: Rig, bus: ServoBus, work: Callable[[Rig, ServoBus], Awaitable[T]]) -> T:
    await rig.start()
    return await work(rig, bus)


def _tell(text: str) -> None:
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"arm-companion: {text}", file=sys.stderr, flush=True)


def _leaves(group: BaseExceptionGroup[BaseException]) -> list[BaseException]:
    found: list[BaseException] = []
    for error in group.exceptions:
        found += _leaves(error) if isinstance(error, BaseExceptionGroup) else [error]
    return found
