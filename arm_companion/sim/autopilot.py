"""The autopilot stand-in: a small flight controller behind the MAVLink face of PX4 or ArduPilot copter.

It joins the parts that stand in files of their own: estimator and cascaded controller (`estimator`,
`flight_control`), modes and failsafes (`autopilot_modes`), commands, set-points, parameters and telemetry, and
the two ports with the routing between them (`mavlink_router`). What differs between the flight stacks is data
in `autopilot_flavours`. Everything random comes from the configured seed.
"""

import asyncio
import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from arm_companion.clock import ticks
from arm_companion.config.schema import Config
from arm_companion.errors import LinkError
from arm_companion.protocol.dialect import mav
from arm_companion.sim.ardupilot_control import ArdupilotController
from arm_companion.sim.autopilot_commands import Commands, GripperOutput
from arm_companion.sim.autopilot_flavours import FLAVOURS, FORWARD, LINK_OPTIONS, TAKEOFF_ALTITUDE, Mode
from arm_companion.sim.autopilot_modes import FlightModes
from arm_companion.sim.autopilot_parameters import Parameters
from arm_companion.sim.autopilot_setpoints import SetpointRefused, decode
from arm_companion.sim.autopilot_streams import StreamTable
from arm_companion.sim.autopilot_telemetry import Battery, Telemetry
from arm_companion.sim.estimator import Estimator
from arm_companion.sim.flight_control import Airframe, Estimate, FlightController
from arm_companion.sim.mavlink_router import SYSTEM, Port, Router, RouterCounters
from arm_companion.sim.ports import RigidState, RotorCommand
from arm_companion.transport.base import Opener

_HOVER_THRUST_ERROR = 0.05
_GYRATION_M = (0.1, 0.1, 0.135)  # what the autopilot was tuned for: radii of a 500 mm frame
_REBOOT_S = 2.0
_REOPEN_S = 0.5
_NO_FORWARDING = 2  # ArduPilot, bit 1 of MAVn_OPTIONS

Handler = Callable[[Any, Port, float], None]
"""Takes a message for the autopilot, the port that it came from, and the loop's time."""


class AutopilotStandIn:
    """Autopilot 1/1 with a companion port and a ground port.

    Args:
        config: mass, seed and estimator noise are taken from it, and the take-off height as PX4's default.
        flavour: `px4` or `ardupilot`.
        ready_s: s from boot until it can be armed; None takes the flavour's own, 8 or 42.

    Raises:
        KeyError: for another flavour.
    """

    period_s = 0.004
    """250 Hz, as PX4 and ArduPilot run their attitude loops and more often than servos answer."""

    def __init__(self, config: Config, flavour: str = "px4", *, ready_s: float | None = None) -> None:
        self._flavour = FLAVOURS[flavour]
        self._config = config
        self._ready_s = self._flavour.ready_s if ready_s is None else ready_s
        self._rng = random.Random(config.sim.seed)  # noqa: S311 - a simulation, repeatable by design
        mass = config.vehicle.mass_kg
        north, east, down = (mass * radius**2 for radius in _GYRATION_M)
        scale = 1.0 + self._rng.uniform(-_HOVER_THRUST_ERROR, _HOVER_THRUST_ERROR)
        frame = Airframe(mass, (north, east, down), scale, thrust_curve=config.sim.thrust_curve)
        self._controller = (FlightController if self._flavour.is_px4 else ArdupilotController)(frame)
        self._estimator = Estimator(self._rng, config.sim.position_noise_m, config.sim.position_wander_m)
        self._battery = Battery()
        defaults = dict(self._flavour.parameters)
        if TAKEOFF_ALTITUDE in defaults:
            defaults[TAKEOFF_ALTITUDE] = config.sim.takeoff_height_m
        self._parameters = Parameters(defaults, bytewise=self._flavour.bytewise_parameters)
        self._modes = FlightModes(self._flavour, self._parameters, self._say)
        self._telemetry = Telemetry(self._flavour, self._modes, self._battery)
        self.gripper = GripperOutput(config.gripper.instance)
        self._commands = Commands(self._flavour, self._modes, self._telemetry, self.reboot, self.gripper)
        self._companion = Port("companion", StreamTable(self._flavour, self._flavour.companion_hz))
        self._ground = Port("ground", StreamTable(self._flavour, self._flavour.ground_hz))
        self._ports = (self._companion, self._ground)
        self._router = Router(self._flavour, self._ports, self._deliver, self._forwards)
        self._booted_at: float | None = None  # loop time of the boot; None: not running
        self._handlers: dict[str, Handler] = {
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "SET_MODE": self._set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._setpoint,
            "PARAM_REQUEST_READ": self._parameter,
            "PARAM_REQUEST_LIST": self._parameter,
            "PARAM_SET": self._parameter,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }

    # What the world sees --------------------

    def due(self) -> bool:
        """It keeps nobody waiting."""
        return True

    def control(self, state: RigidState, dt: float) -> RotorCommand:
        """One step of estimator and controller; call at 250 Hz or more.

        Args:
            state: true motion now.
            dt: s since the last call.

        Returns:
            What the rotors exert until the next call.
        """
        estimate = self._estimator.update(state, dt)
        demand = self._modes.demand(estimate, dt)
        if demand is None or demand.touching:
            self._controller.reset()
            rotors = self._controller.idle(dt)
        else:
            rotors = self._controller.update(estimate, demand.setpoint, dt, demand.release)
        self._modes.thrust_share = self._controller.thrust
        self._battery.draw(self._controller.thrust, dt)
        self._controller.supply = self._battery.thrust_share
        return rotors

    def take_over(self, mode: str) -> None:
        """The pilot's mode switch: from now on external set-points do not count.

        Args:
            mode: the flight stack's own name, such as POSCTL or LOITER.

        Raises:
            ValueError: when the stack has no mode of that name.
        """
        try:
            chosen = self._flavour.names[mode]
        except KeyError:
            raise ValueError(f"{mode} is none of {', '.join(self._flavour.names)}") from None
        self._modes.take_over(chosen)

    def fail(self) -> None:
        """An emergency: the vehicle sinks where it is and obeys nobody but the pilot."""
        self._modes.fail()

    def mission_item(self, command: int, parameters: Sequence[float]) -> None:
        """An item of a mission comes up: PX4 sends commands for others out to all of its system, ArduPilot does not.

        Args:
            command: MAV_CMD.
            parameters: its first ones; the others are zero.
        """
        if self._flavour.is_px4:
            numbers = (*parameters, *[0.0] * (7 - len(parameters)))
            self._broadcast(mav.MAVLink_command_long_message(SYSTEM, 0, command, 0, *numbers))

    def reboot(self) -> None:
        """Power-cycle: rotors off, silence, then a boot with default streams and no routes."""
        loop = asyncio.get_running_loop()
        self._booted_at = loop.time() + _REBOOT_S
        self._modes.boot()
        self._controller.reset()
        for port in self._ports:
            port.streams.reset()
            port.routes.clear()

    @property
    def mode(self) -> Mode:
        """The mode that flies now."""
        return self._modes.mode

    @property
    def armed(self) -> bool:
        """Whether the rotors may turn."""
        return self._modes.armed

    @property
    def landed(self) -> bool:
        """The landed detector's word."""
        return self._modes.landed

    @property
    def estimate(self) -> Estimate:
        """The estimator's present idea of the motion."""
        return self._modes.estimate

    @property
    def counters(self) -> RouterCounters:
        """What the ports received, forwarded and dropped."""
        return self._router.counters

    # Links --------------------

    async def run(self, companion: Opener, ground: Opener) -> None:
        """Serve both ports until cancelled; a lost link is opened again.

        Args:
            companion: opens the port to the companion computer.
            ground: opens the port to the ground station.
        """
        self._booted_at = asyncio.get_running_loop().time()
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._keep_open(self._companion, companion))
                group.create_task(self._keep_open(self._ground, ground))
                group.create_task(self._main_loop())
        finally:
            self._booted_at = None

    async def _keep_open(self, port: Port, opener: Opener) -> None:
        while True:
            try:
                transport = await opener(partial(self._receive, port))
            except LinkError:
                await asyncio.sleep(_REOPEN_S)
                continue
            port.connect(transport)
            try:
                await transport.wait_closed()
            finally:
                transport.close()
                port.disconnect()
            await asyncio.sleep(_REOPEN_S)

    def _receive(self, port: Port, data: bytes) -> None:
        if self._up_s(asyncio.get_running_loop().time()) >= 0.0:
            self._router.receive(port, data)

    async def _main_loop(self) -> None:
        """Watch the set-point stream and send what is due."""
        async for tick in ticks(1.0 / self._flavour.loop_hz):
            up = self._up_s(tick.now)
            if up < 0.0:
                continue
            self._modes.ready = up >= self._ready_s
            self._modes.tick(tick.now)
            self._telemetry.now_s = up
            for port in self._ports:
                for number in port.streams.due(tick.now):
                    message = self._telemetry.build(number)
                    if message is not None:
                        port.send(message)

    def _up_s(self, now: float) -> float:
        """Seconds since boot, negative while rebooting or not running."""
        return -1.0 if self._booted_at is None else now - self._booted_at

    def _broadcast(self, message: Any) -> None:
        for port in self._ports:
            port.send(message)

    def _say(self, severity: int, text: str) -> None:
        if self._booted_at is not None:
            self._broadcast(mav.MAVLink_statustext_message(severity, text.encode()[:50]))

    def _forwards(self) -> bool:
        if self._flavour.is_px4:
            return bool(self._parameters[FORWARD])
        return not int(self._parameters[LINK_OPTIONS]) & _NO_FORWARDING

    # Messages for the autopilot itself --------------------

    def _deliver(self, message: Any, port: Port) -> None:
        now = asyncio.get_running_loop().time()
        self._telemetry.now_s = self._up_s(now)
        handler = self._handlers.get(message.get_type())
        if handler is not None:
            handler(message, port, now)

    def _command(self, message: Any, port: Port, now: float) -> None:
        loop = asyncio.get_running_loop()
        delay = 0.0
        for ack in self._commands.handle(message, now, port):
            delay += self._rng.uniform(*self._flavour.ack_delay_s)
            loop.call_later(delay, port.send, ack)

    def _set_mode(self, message: Any, _port: Port, now: float) -> None:
        self._commands.set_mode(message.custom_mode, now)

    def _setpoint(self, message: Any, _port: Port, now: float) -> None:
        try:
            setpoint = decode(message, self._flavour, self.estimate.yaw)
        except SetpointRefused as refused:
            if refused.stops:
                self._modes.set_external(None, now)
            return
        self._modes.set_external(setpoint, now)

    def _parameter(self, message: Any, port: Port, _now: float) -> None:
        for answer in self._parameters.answers(message):
            port.send(answer)

    def _timesync(self, message: Any, port: Port, now: float) -> None:
        if message.tc1 == 0:
            port.send(mav.MAVLink_timesync_message(int(self._up_s(now) * 1e9), message.ts1))

    def _ping(self, message: Any, port: Port, _now: float) -> None:
        if message.target_system == 0:
            source = (message.get_srcSystem(), message.get_srcComponent())
            port.send(mav.MAVLink_ping_message(message.time_usec, message.seq, *source))
