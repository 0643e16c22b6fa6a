"""The composition root: byte pipes and a clock in, the running daemon out."""

import asyncio
import contextlib
import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from arm_companion.arm import compiled
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.clock import Clock, Tick, ticks
from arm_companion.config.schema import Config
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.component import Component
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.telemetry import Telemetry
from arm_companion.drivers.tendons import Tendons
from arm_companion.errors import ConfigError, DeviceFault, ModelError
from arm_companion.mission.facts import ArmAction, Bar, Commands, Facts, Notice, Severity
from arm_companion.mission.mission import SAFE_ACTION, step
from arm_companion.mission.situation import Parameters
from arm_companion.mission.state import MOVES_VEHICLE, State
from arm_companion.recorder import FileRecorder, NoRecorder, Record, Recorder
from arm_companion.supervisor import ServiceManager, run_until
from arm_companion.transport.base import Opener
from arm_companion.transport.serial import open_serial
from arm_companion.transport.urls import open_url

log = logging.getLogger(__name__)

_REARM_EVERY_S = 1.0
_HEARTBEAT_FIRST_S = 0.1  # importing numba leaves the loop little time
_LEVELS = {
    Severity.CRITICAL: logging.CRITICAL,
    Severity.ERROR: logging.ERROR,
    Severity.WARNING: logging.WARNING,
    Severity.NOTICE: logging.INFO,
    Severity.INFO: logging.INFO,
}


@dataclass(frozen=True)
class Openers:
    """How to open everything that the daemon talks through."""

    links: Mapping[str, Opener]
    servos: Opener


def open_configured(config: Config) -> Openers:
    """The real transports that a configuration names.

    Raises:
        ConfigError: a link's URL cannot be read.
    """
    return Openers(
        {name: open_url(link.url) for name, link in config.links.items()},
        open_serial(config.servos.port, config.servos.baud),
    )


class Daemon:
    """Everything that runs on the companion computer, and the cycle that drives it."""

    def __init__(
        self,
        config: Config,
        openers: Openers,
        clock: Clock,
        manager: ServiceManager,
        recorder: Recorder | None = None,
        *,
        compiled_model: bool = False,
    ) -> None:
        if not any(link.role == "autopilot" for link in config.links.values()):
            raise ConfigError("links: none has the role autopilot")
        if config.arm.segments:
            raise ConfigError("arm.segments: the perch is flown by an arm of one segment")
        config.check_servos()
        self._config = config
        self._clock = clock
        self._manager = manager
        self._recorder = _recorder(config, clock) if recorder is None else recorder
        self._compiled_model = compiled_model
        self._parameters = Parameters(config, RodModel(ArmParameters.of(config.arm)))
        self._links = [
            MavlinkLink(name, link.role, openers.links[name], config.vehicle) for name, link in config.links.items()
        ]
        (autopilot_link,) = (link for link in self._links if link.role == "autopilot")
        self._autopilot = Autopilot(autopilot_link, config.vehicle)
        self._component = Component(self._links, config.vehicle, clock)
        self._telemetry = Telemetry(self._links, config.rates, clock)
        self._bus = ServoBus(openers.servos, config.servos)
        self._tendons = Tendons(config.servos, config.limits, config.arm.pulley_radius_m)
        self._state = State()
        self._bar: Bar | None = None
        self._rearm_at = 0.0
        self._last: Commands | None = None
        self.cycles = 0
        self.missed = 0
        self.failures = 0

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until `stop` is set, then leave the arm in the present phase's safe action.

        Raises:
            BaseExceptionGroup: a part failed in a way that its owner cannot mend.
        """
        try:
            await run_until(
                stop,
                *(link.run for link in self._links),
                self._autopilot.run,
                self._component.run,
                self._bus.run,
                self._cycles,
            )
        finally:
            self._manager.stopping()
            action = SAFE_ACTION[self._state.phase]
            log.info("stopping in %s: the arm will %s", self._state.phase.name, action.value)
            try:
                await self._bus.stop(limp=action is ArmAction.LIMP)
            except* DeviceFault as faults:
                log.error("stopping: %s", "; ".join(str(fault) for fault in faults.exceptions))  # noqa: TRY400
            finally:
                for link in self._links:
                    link.close()
                self._recorder.close()

    async def _prepare_model(self) -> None:
        """The compiled mechanics from numba's cache, where there are any; links and heartbeats run meanwhile.

        Before the first cycle: a model that changed between two cycles would spoil the record's replay.
        """
        await asyncio.sleep(_HEARTBEAT_FIRST_S)
        model = self._parameters.model

        def load() -> RodModel:
            compiled.load(compiling=False)
            fast = RodModel(model.parameters, fast=True)
            with contextlib.suppress(ModelError):
                fast.free([0.0] * model.parameters.n, (0.0, 0.0, 0.0))  # builds its tables
            return fast

        try:
            self._parameters = dataclasses.replace(self._parameters, model=await asyncio.to_thread(load))
        except compiled.NotCompiled as reason:
            log.log(logging.WARNING if compiled.installed() else logging.INFO, "mechanics on NumPy: %s", reason)
        else:
            log.info("mechanics compiled by numba")

    async def _cycles(self) -> None:
        if self._compiled_model:
            await self._prepare_model()
        self._manager.ready()
        async for tick in ticks(1.0 / self._config.rates.cycle_hz):
            self.missed += tick.missed
            try:
                await self._cycle()
            except Exception:
                self.failures += 1
                log.exception("cycle failed in %s; safe action", self._state.phase.name)
                await self._fall_back(tick)
            else:
                self._manager.alive()
            self.cycles += 1

    async def _cycle(self) -> None:
        facts = await self._observe()
        now = self._clock.now()
        before = self._state
        self._state, commands = step(before, facts, now, self._parameters)
        await self._act(commands, facts, now)
        self._recorder.put(Record(now, facts, before, commands))

    async def _observe(self) -> Facts:
        servos = await self._bus.read()
        now = self._clock.now()
        if any(servo.tripped for servo in servos) and now >= self._rearm_at:
            self._rearm_at = now + _REARM_EVERY_S
            await self._rearm()
        requests, bar = self._component.take()
        self._bar = bar or self._bar
        return Facts(self._autopilot.state(now), self._tendons.states(servos), tuple(requests), self._bar)

    async def _rearm(self) -> None:
        """Servos stopped where they were because the bus was silent; goals go on from there."""
        text = "servo bus was silent too long: servos held, goals go on from where they are"
        log.warning(text)
        self._component.notify(Notice(Severity.WARNING, text))
        self._tendons.rest()
        try:
            await self._bus.start()
        except* DeviceFault as faults:
            log.error("re-arming: %s", "; ".join(str(fault) for fault in faults.exceptions))  # noqa: TRY400

    async def _act(self, commands: Commands, facts: Facts, now: float) -> None:
        """Servos first: they are what a late cycle hurts most."""
        self._last = commands
        match commands.arm:
            case ArmAction.DRIVE if commands.pulls is not None:
                await self._bus.write(self._tendons.goals(commands.pulls, now), torque=True)
            case ArmAction.LIMP:
                await self._bus.limp()
            case _:
                self._tendons.rest()
        if commands.setpoint is not None:
            self._autopilot.send(commands.setpoint, now)
        for answer in commands.answers:
            self._component.answer(answer)
        for notice in commands.notices:
            log.log(_LEVELS[notice.severity], "%s", notice.text)
            self._component.notify(notice)
        self._component.active = self._state.phase in MOVES_VEHICLE
        self._telemetry.publish(now, commands.status, facts.tendons, commands.wrench, commands.pulls)

    async def _fall_back(self, tick: Tick) -> None:
        """The safe action after an exception: goals stay, and the vehicle is held where it was asked to be."""
        last = self._last
        try:
            if SAFE_ACTION[self._state.phase] is ArmAction.LIMP:
                await self._bus.limp()
            if last is not None and last.setpoint is not None:
                still = dataclasses.replace(last.setpoint, velocity_w=(0.0, 0.0, 0.0))
                self._autopilot.send(still, tick.now)
            if self.failures == 1 or self.failures % 100 == 0:
                text = f"cycle failed {self.failures} times; arm and vehicle hold"
                self._component.notify(Notice(Severity.CRITICAL, text))
        except Exception:
            log.exception("the safe action failed too")


def _recorder(config: Config, clock: Clock) -> Recorder:
    if config.record.file:
        return FileRecorder(Path(config.record.file))
    if not config.record.directory:
        return NoRecorder()
    start = datetime.fromtimestamp(clock.unix(clock.now()), UTC)
    return FileRecorder(Path(config.record.directory) / f"{start:%Y%m%d-%H%M%S}.jsonl")
