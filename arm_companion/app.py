"""The composition root: byte pipes and a clock in, the running daemon out."""

import asyncio
import dataclasses
import gc
import logging
from collections.abc import Mapping
from dataclasses import dataclass

from arm_companion.arm import compiled
from arm_companion.arm.model import ArmModel
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel, compiled_model
from arm_companion.clock import Clock, Tick, ticks
from arm_companion.config.flyable import check_flyable
from arm_companion.config.gripper_options import with_gripper
from arm_companion.config.schema import Config
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.calibrated import Calibrated
from arm_companion.drivers.component import Component
from arm_companion.drivers.computer import ComputerWatch
from arm_companion.drivers.forwarding import Forwarding
from arm_companion.drivers.gripper import gripper_of
from arm_companion.drivers.gripper_servo import own_settings
from arm_companion.drivers.keeper import Keeper
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.mqtt_payloads import Health
from arm_companion.drivers.recalibration import Recalibration
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.servo_telemetry import ServoTelemetry
from arm_companion.drivers.settings import Settings, state_directory
from arm_companion.drivers.signing_keys import SigningKeys
from arm_companion.drivers.standard_services import Power
from arm_companion.drivers.system_status import in_trouble, system_status
from arm_companion.drivers.telemetry import Telemetry
from arm_companion.drivers.timesync import Timesync
from arm_companion.drivers.vehicle_check import VehicleCheck
from arm_companion.errors import DeviceFault
from arm_companion.last_writes import wait_for
from arm_companion.live.feed import Address
from arm_companion.mission.facts import ArmAction, Bar, Commands, Control, Facts, Notice, Severity
from arm_companion.mission.mission import SAFE_ACTION, step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import MOVES_VEHICLE, Phase, State
from arm_companion.onlookers import Onlookers
from arm_companion.record import configured_recorder
from arm_companion.record.raw import Taps
from arm_companion.record.recorder import Record, Recorder, failed_cycle
from arm_companion.supervisor import ServiceManager, run_until
from arm_companion.transport.base import Opener
from arm_companion.transport.urls import open_bus, open_url

log = logging.getLogger(__name__)

_REARM_EVERY_S = 1.0
_HEARTBEAT_FIRST_S = 0.1  # importing numba leaves the loop little time
_FAREWELL_S = 0.3
_AT_REST = frozenset({Phase.STARTUP, Phase.STOWED})
_LEVELS = {Severity.CRITICAL: logging.CRITICAL, Severity.ERROR: logging.ERROR, Severity.WARNING: logging.WARNING}


@dataclass(frozen=True)
class Openers:
    """How to open everything that the daemon talks through."""

    links: Mapping[str, Opener]
    servos: Opener


def open_configured(config: Config) -> Openers:
    """The real transports that a configuration names.

    Raises:
        ConfigError: the URL of a link or of the servo bus cannot be read.
    """
    return Openers(
        {name: open_url(link.url) for name, link in config.links.items()},
        open_bus(config.servos.port, config.servos.baud),
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
        model: ArmModel | None = None,
        computer: ComputerWatch | None = None,
        live: Address | None = None,
    ) -> None:
        check_flyable(config)
        self._config = config
        self._clock = clock
        self._manager = manager
        self._recorder = configured_recorder(config, clock) if recorder is None else recorder
        self._recorder.configure(clock.now(), config)
        self._taps = Taps(self._recorder)
        self._compiled_model = compiled_model
        self._parameters = Parameters(config, model or RodModel(ArmParameters.of(config.arm)))
        self._links = [
            MavlinkLink(
                name, link.role, self._taps.tapped(openers.links[name], f"mavlink/{name}"), config.vehicle, config=link
            )
            for name, link in config.links.items()
        ]
        self._keeper = Keeper()
        self._keys = SigningKeys(config, self._keeper)
        self._keys.secure(self._links, clock)
        self._forwarding = Forwarding([link for link in self._links if link.config.forward])
        (autopilot_link,) = (link for link in self._links if link.role == "autopilot")
        self._timesync = Timesync(autopilot_link, clock)
        self._autopilot = Autopilot(autopilot_link, config.vehicle, self._timesync)
        self._settings = Settings(config, state_directory(config), self._keeper)
        self._settings.stowed, self._settings.apply = self._why_not_stowed, self._apply
        self._component = Component(
            self._links,
            config.vehicle,
            clock,
            mavlink=config.mavlink,
            limits=config.limits,
            settings=self._settings,
            on_power=self._end,
        )
        self._component.hearers.append(lambda notice: self._recorder.notice(clock.now(), notice))
        self.vehicle_check = VehicleCheck(
            autopilot_link, self._autopilot, config.vehicle, config.mavlink, self._component.notify
        )
        self._computer = computer
        self._telemetry = Telemetry(self._links, config.rates, clock, computer.message if computer else None)
        self._servo_telemetry = ServoTelemetry(self._links, config.rates, clock)
        self._onlookers = Onlookers(config, clock, self._component.commands, live)
        self._component.hearers.append(self._onlookers.notice)
        self._started = clock.now()
        self._calibrated = Calibrated(config, clock.unix(clock.now()))
        self._bus = ServoBus(
            self._taps.tapped(openers.servos, "servos"),
            with_gripper(self._calibrated.servos, config.gripper_servo),
            parked=self._calibrated.parked,
            parked_window=config.calibration.turned_ticks,
            own_settings=own_settings(config),
        )
        self._recalibration = Recalibration(config, self._calibrated, self._bus, self._rezero)
        self._tendons = self._calibrated.tendons(config)
        self._gripper = gripper_of(config, autopilot_link, self._autopilot)
        self._state = State()
        self._bar: Bar | None = None
        self._rearm_at = 0.0
        self._ready = (False,) * len(config.servos.ids)
        self._recovering: asyncio.Task[None] | None = None
        self._last: Commands | None = None
        self.cycles = 0
        self.missed = 0
        self.failures = 0
        self.power = Power.STOP
        """What is to follow the end of `run`: another start, or nothing."""
        self._stop = asyncio.Event()

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until `stop` is set, then leave the arm in the present phase's safe action.

        Raises:
            BaseExceptionGroup: a part failed in a way that its owner cannot mend.
        """
        self._stop = stop
        try:
            await run_until(
                stop,
                *(link.run for link in self._links),
                self._autopilot.run,
                self._timesync.run,
                self.vehicle_check.run,
                self._component.run,
                self._keys.run,
                self._bus.run,
                *self._onlookers.runs,
                *(() if self._computer is None else (self._computer.run,)),
                self._cycles,
            )
        finally:
            self._manager.stopping()
            if self._recovering is not None:
                self._recovering.cancel()
            action = SAFE_ACTION[self._state.phase]
            log.info("stopping in %s: the arm will %s", self._state.phase.name, action.value)
            try:
                await self._bus.stop(limp=action is ArmAction.LIMP)
            except* DeviceFault as faults:
                log.error("stopping: %s", "; ".join(str(fault) for fault in faults.exceptions))  # noqa: TRY400
            finally:
                for link in self._links:
                    link.close()
                self._keys.keep()
                ends = (self._recalibration.end, self._calibrated.end, self._keeper.end, self._recorder.end)
                wait_for([ending for end in ends for ending in end()])

    async def _prepare_model(self) -> None:
        """The compiled mechanics from numba's cache, where there are any; links and heartbeats run meanwhile.

        Before the first cycle: a model that changed between two cycles would spoil the record's replay.
        """
        await asyncio.sleep(_HEARTBEAT_FIRST_S)
        model = self._parameters.model

        try:
            fast = await asyncio.to_thread(compiled_model, model.parameters)
            self._parameters = dataclasses.replace(self._parameters, model=fast)
        except compiled.NotCompiled as reason:
            log.log(logging.WARNING if compiled.installed() else logging.INFO, "mechanics on NumPy: %s", reason)
        else:
            log.info("mechanics compiled by numba")

    async def _cycles(self) -> None:
        if self._compiled_model:
            await self._prepare_model()
            gc.set_threshold(10_000)  # what a record keeps for a moment is no garbage
            gc.freeze()  # modules and compiled code are here to stay: to look through them took 80 ms, in flight
        if isinstance(self._parameters.model, RodModel):
            self._recorder.mechanics("numba" if self._parameters.model.fast else "numpy")
        self._manager.ready()
        for warning in self._calibrated.warnings:
            log.warning("%s", warning)
            self._component.notify(Notice(Severity.WARNING, warning))
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
        self._taps.hand_over(self._clock.now())
        facts = await self._observe()
        now = self._clock.now()
        before = self._state
        try:
            self._state, commands = step(before, facts, now, self._parameters)
        except Exception as error:
            self._recorder.failed(failed_cycle(now, facts, before, error))
            raise
        try:
            await self._act(commands, facts, now)
        finally:  # memory has moved on: without this cycle the record would not lead to the next
            self._recorder.put(record := Record(now, facts, before, commands))
        self._onlookers.publish(record, Situation(self._state, facts, now, self._parameters), self._health)
        for text in self._recorder.troubles():
            log.warning("%s", text)
            self._component.notify(Notice(Severity.WARNING, text))
        for text in self._keeper.troubles():  # what the ground has set counts now, and would not after a restart
            self._component.notify(Notice(Severity.WARNING, text))

    async def _observe(self) -> Facts:
        every = await self._bus.read()
        servos = every[: len(self._config.servos.ids)]  # the tendons'; a gripper's may be behind them
        now = self._clock.now()
        if now >= self._rearm_at and self._bus.connected and any(s.tripped and not s.silent for s in every):
            self._rearm_at = now + _REARM_EVERY_S
            await self._rearm()
        ready = tuple(servo.ready for servo in servos)
        if any(now_ready and not before for now_ready, before in zip(ready, self._ready, strict=True)):
            self._tendons.rest()  # what follows again starts from where it is, at the tendons' own speed
        self._ready = ready
        self._servo_telemetry.publish(now, every, self._bus.counters)
        requests, bar = self._component.take()
        workshop = self._recalibration.facts(servos, requests, self._state.phase)
        self._bar = bar or self._bar
        guidance = self._component.guidance
        grasp_target, grasp_target_age_s = guidance.grasp_target
        return Facts(
            self._autopilot.state(now),
            self._tendons.states(servos),
            tuple(requests),
            self._bar,
            bar_age_s=guidance.bar_age_s,
            grasp_target=grasp_target,
            grasp_target_age_s=grasp_target_age_s,
            arm_setpoint=guidance.setpoint,
            ground_age_s=self._component.access.ground_age_s,
            calibration=self._calibrated.judge(self._bus.info, servos),
            workshop=workshop,
            gripper=self._gripper.state(every, now),
        )

    async def _rearm(self) -> None:
        """Servos stopped where they were because the bus was silent; goals go on from there."""
        text = "servo bus was silent too long: servos held, goals go on from where they are"
        log.warning(text)
        self._component.notify(Notice(Severity.WARNING, text))
        self._tendons.rest()
        try:
            await self._bus.rearm()
        except* DeviceFault as faults:
            log.error("re-arming: %s", "; ".join(str(fault) for fault in faults.exceptions))  # noqa: TRY400

    async def _recover(self) -> None:
        """CLEAR_ERRORS: the cycle goes on meanwhile, and sees in the servos' states what became of it."""
        try:
            await self._bus.recover()
        except* DeviceFault as faults:
            for fault in faults.exceptions:
                log.error("clearing errors: %s", fault)  # noqa: TRY400 - a fault of a device, not of the program
                self._component.notify(Notice(Severity.WARNING, str(fault)))

    async def _act(self, commands: Commands, facts: Facts, now: float) -> None:
        """Servos first: they are what a late cycle hurts most."""
        self._last = commands
        jaws = self._gripper.goals(commands.gripper, now)
        match commands.arm:
            case ArmAction.DRIVE if commands.pulls is not None:
                await self._bus.write((*self._tendons.goals(commands.pulls, now), *jaws), torque=True)
            case ArmAction.WIND if commands.pulls is not None:
                self._tendons.rest()
                goals = self._recalibration.goals(commands.pulls, self._config.limits, now)
                await self._bus.write((*goals, *jaws), torque=True)
            case ArmAction.LIMP:
                await self._recalibration.let_go()
            case _:
                self._tendons.rest()
                if any(goal is not None for goal in jaws):
                    await self._bus.write((*[None] * len(facts.tendons), *jaws))
        if commands.zeros:
            self._recalibration.store(commands.zeros, self._clock.unix(now))
        if commands.recover and (self._recovering is None or self._recovering.done()):
            self._recovering = asyncio.create_task(self._recover())
        if commands.setpoint is not None:
            self._autopilot.send(commands.setpoint, now)
        for answer in commands.answers:
            self._component.answer(answer)
        for notice in commands.notices:
            log.log(_LEVELS.get(notice.severity, logging.INFO), "%s", notice.text)
            self._component.notify(notice)
        self._component.active = self._state.phase in MOVES_VEHICLE
        self._component.status = system_status(commands.status, active=self._component.active)
        self._telemetry.holder = self._component.access.holder
        self._telemetry.publish(
            now,
            commands.status,
            facts.tendons,
            commands.wrench,
            commands.pulls,
            tensions=commands.tensions,
            stiffness=commands.stiffness,
            payload=commands.payload,
        )

    def _health(self) -> Health:
        links = {link.name: link.connected for link in self._links}
        return Health(self._clock.now() - self._started, self.cycles, self.missed, self.failures, links)

    async def _fall_back(self, tick: Tick) -> None:
        """The safe action after an exception: goals stay, and the vehicle is held where it was asked to be."""
        last = self._last
        self._component.status = in_trouble(last.status if last is not None else None)
        try:
            if SAFE_ACTION[self._state.phase] is ArmAction.LIMP:
                await self._recalibration.let_go()
            if last is not None and last.setpoint is not None:
                vehicle = self._autopilot.state(tick.now)
                if vehicle.armed and vehicle.control is Control.EXTERNAL:
                    still = dataclasses.replace(last.setpoint, velocity_w=(0.0, 0.0, 0.0))
                    self._autopilot.send(still, tick.now)
                else:  # for good: who takes the vehicle and gives it back has flown it elsewhere
                    self._last = dataclasses.replace(last, setpoint=None)
            if self.failures == 1 or self.failures % 100 == 0:
                text = f"cycle failed {self.failures} times; arm and vehicle hold"
                self._component.notify(Notice(Severity.CRITICAL, text))
        except Exception:
            log.exception("the safe action failed too")

    # --- what the ground may change ---

    def _why_not_stowed(self) -> str | None:
        phase = self._state.phase
        return None if phase in _AT_REST else f"it is {phase.name}"

    def _rezero(self) -> None:
        """Other zeros of the tendons are in use."""
        self._tendons = self._calibrated.tendons(self._config)

    def _apply(self, config: Config) -> None:
        """Another configuration is in force; only values of `config.parameters` differ."""
        if config.limits != self._config.limits:
            self._tendons = self._calibrated.tendons(config)
            self._component.set_limits(config.limits)
        self._config = config
        self._recorder.configure(self._clock.now(), config)
        self._onlookers.configure(config)
        self._parameters = Parameters(config, self._parameters.model)
        self._telemetry.set_rates(config.rates)

    def _end(self, power: Power) -> None:
        """Stop in an orderly way, a moment later: the answer to whoever asked has to leave first."""
        self.power = power
        asyncio.get_running_loop().call_later(_FAREWELL_S, self._stop.set)
