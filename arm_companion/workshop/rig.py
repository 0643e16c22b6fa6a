"""Carries out the actions of a procedure on the servo bus, and leaves the arm safe whatever ends it."""

import asyncio
import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from arm_companion.clock import ticks
from arm_companion.config.schema import LimitsConfig, ServosConfig
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.tendons import Tendons
from arm_companion.errors import ArmError, DeviceFault
from arm_companion.procedures.actions import (
    Action,
    Ask,
    AskNumber,
    Engage,
    Keep,
    Move,
    Procedure,
    Release,
    Sample,
    Say,
    Trace,
)
from arm_companion.procedures.moves import Moving
from arm_companion.protocol.control_table import TICK_RAD

PERIOD_S = 0.01
_TORQUE_S = 2.0
_EASE_M_PER_S = 0.02
_EASE_S = 6.0
_BOOT_CYCLES = 30
T = TypeVar("T")


class Aborted(ArmError):
    """The person ended it, or nobody is there to answer."""


class Console(Protocol):
    """Whoever is being guided."""

    def say(self, text: str) -> None:
        """Show something."""

    async def ask(self, text: str, *, sure: bool) -> str | None:
        """The line that answers; None when nobody will. `sure`: an empty answer may be given for them."""


class Rig:
    """The servos of an arm on the bench, driven one action at a time.

    Args:
        bus: opened by `start`, nobody else uses it.
        servos: configuration; its zeros do not count.
        limits: hold on all that leaves, counted from where the torque came on.
        pulley_radius_m: of all pulleys.
    """

    def __init__(self, bus: ServoBus, servos: ServosConfig, limits: LimitsConfig, pulley_radius_m: float) -> None:
        self._bus = bus
        # what one servo winds up, not what a tendon moves: the procedures deal with coupling themselves
        self._config = dataclasses.replace(servos, coupling=())
        # slack is what these procedures begin with
        self._limits = dataclasses.replace(limits, tension_min_n=0.0)
        self._radius = pulley_radius_m
        self._tendons: Tendons | None = None
        self._goal: tuple[float, ...] | None = None
        self._engaged = False

    async def start(self) -> None:
        """Open the bus; servos that lost their turns count from where they are.

        Raises:
            LinkError: the port cannot be opened; another program may have it.
            ExceptionGroup: of one `DeviceFault` for each servo that is not well.
        """
        await self._bus.start()
        states: tuple[ServoState, ...] = ()
        for _ in range(_BOOT_CYCLES):
            states = await self._bus.read()
            if not any(state.silent or state.age_s > 1.0 for state in states):
                break
            await asyncio.sleep(PERIOD_S)
        for state in states:
            if state.turns_lost:
                await self._bus.accept_position(state.id, state.position)
        await self._cycle()

    async def run(self, procedure: Procedure[T], console: Console, keep: Callable[[Any], None]) -> T:
        """Carry a procedure through.

        Args:
            procedure: not started yet.
            console: whom it guides.
            keep: stores partial results.

        Raises:
            Aborted: the person said so.
            DeviceFault: a servo failed on the way.
            ArmError: whatever the procedure raises.
        """
        answer: Any = None
        try:
            while True:
                try:
                    action = procedure.send(answer)
                except StopIteration as end:
                    return end.value  # type: ignore[no-any-return]
                answer = await self._perform(action, console, keep)
        finally:
            procedure.close()

    async def _perform(self, action: Action, console: Console, keep: Callable[[Any], None]) -> Any:
        match action:
            case Say(text):
                console.say(text)
            case Keep(value):
                keep(value)
            case Ask(text, sure):
                return await self._hold_while(self._ask(console, text, sure=sure))
            case AskNumber(text):
                return await self._hold_while(self._ask_number(console, text))
            case Engage():
                return await self.engage()
            case Release():
                return await self.release()
            case Move():
                return await self.move(action)
        return None

    async def _ask(self, console: Console, text: str, *, sure: bool) -> bool:
        while True:
            line = await console.ask(text, sure=sure)
            if line is None:
                raise Aborted("nobody answers")
            match line.strip().lower():
                case "" | "y" | "yes":
                    return True
                case "n" | "no":
                    return False
                case "q" | "quit":
                    raise Aborted("ended by you")
            text = "Enter to go on, n for no, q to end."

    async def _ask_number(self, console: Console, text: str) -> float | None:
        while True:
            line = await console.ask(text, sure=False)
            if line is None:
                raise Aborted("nobody answers")
            word = line.strip().lower().replace(",", ".")
            if not word:
                return None
            if word in {"q", "quit"}:
                raise Aborted("ended by you")
            with contextlib.suppress(ValueError):
                return float(word)
            text = "A number, an empty line to go on, or q to end."

    async def _hold_while(self, answer: Any) -> Any:
        """Keep the servos and their watchdogs content until somebody has answered."""
        task = asyncio.ensure_future(answer)
        try:
            async for _ in ticks(PERIOD_S):
                await self._cycle()
                if task.done():
                    return task.result()
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, ArmError):
                await task
        return None

    # What the servos do.

    async def engage(self) -> tuple[int, ...]:
        """Torque on, all servos staying where they are; their positions, ticks.

        Raises:
            DeviceFault: one does not come on.
        """
        states = await self._cycle()
        origin = tuple(state.position for state in states)
        self._tendons = Tendons(dataclasses.replace(self._config, zero_ticks=origin), self._limits, self._radius)
        self._goal = (0.0,) * len(origin)
        self._engaged = True
        until = asyncio.get_running_loop().time() + _TORQUE_S
        async for tick in ticks(PERIOD_S):
            states = await self._cycle()
            off = [state.id for state in states if not state.torque]
            if not off:
                break
            if tick.now > until:
                raise DeviceFault(off[0], 0, "its torque does not come on")
        return origin

    async def release(self) -> tuple[int, ...]:
        """Torque off; positions, ticks.

        Raises:
            ExceptionGroup: of one `DeviceFault` for each servo that may still hold.
        """
        self._tendons = self._goal = None
        await self._bus.limp()
        self._engaged = False
        return tuple(state.position for state in await self._bus.read())

    async def move(self, action: Move) -> Trace:
        """Drive all servos along a straight way, and record it.

        Raises:
            DeviceFault: a servo failed.
            Refused: one does not follow.
        """
        start = self._goal
        if start is None:
            raise Aborted("the torque is off")
        moving = Moving(action, start)
        async for _ in ticks(PERIOD_S):
            moving = moving.on(PERIOD_S)
            self._goal = moving.goal
            sample = self._sample(await self._cycle())
            moving, trace = moving.measured(sample)
            if trace is not None:
                self._goal = sample.wound if trace.stopped else self._goal  # and no further
                return trace
        raise Aborted("time has ended")

    def _sample(self, states: Sequence[ServoState]) -> Sample:
        signs, tendons = self._config.directions, self._tendons
        return Sample(
            tuple(tendons.wound(i, state.position) for i, state in enumerate(states)) if tendons else (),
            tuple(sign * state.load for sign, state in zip(signs, states, strict=True)),
            tuple(state.voltage for state in states),
            tuple(state.temperature for state in states),
        )

    async def _cycle(self) -> tuple[ServoState, ...]:
        """Hear all servos and, while the torque is on, drive them to the goal within the limits."""
        states = await self._bus.read()
        for state in states:
            if (fault := state.fault) is not None:
                raise fault
        if self._tendons is not None and self._goal is not None:
            self._tendons.states(states)
            goals = self._tendons.goals(self._goal, asyncio.get_running_loop().time())
            await self._bus.write(goals, torque=True)
        return states

    async def make_safe(self) -> None:
        """Take the tendons back to where they were when the torque came on, slowly, then switch the torque off.

        What cannot be done any more is left out; the torque is switched off in any case. A rig that never switched
        it on does nothing.

        Raises:
            ExceptionGroup: of one `DeviceFault` for each servo that may still hold.
        """
        if not self._engaged:
            return
        try:
            if self._goal is not None:
                with contextlib.suppress(ArmError, TimeoutError):
                    async with asyncio.timeout(_EASE_S):
                        await self.move(Move((0.0,) * len(self._goal), _EASE_M_PER_S))
        finally:
            self._tendons = self._goal = None
            await self._bus.limp()
            self._engaged = False


def m_per_tick(pulley_radius_m: float) -> float:
    """Length that one tick winds up, m."""
    return TICK_RAD * pulley_radius_m
