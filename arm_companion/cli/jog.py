"""`arm-companion jog`: bend the arm from the keyboard, on the servo bus, while no daemon runs."""

import argparse
import asyncio
import contextlib
import math
import signal
import sys

import numpy as np

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.reaction import GRAVITY
from arm_companion.arm.rod_model import RodModel
from arm_companion.cli.common import add_config_arguments, load_from
from arm_companion.cli.keyboard import Keyboard
from arm_companion.clock import run_real_time, ticks, unix_now
from arm_companion.config import Config
from arm_companion.drivers.calibrated import Calibrated
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.tendons import Tendons
from arm_companion.errors import ArmError, DeviceFault, LinkError, ModelError
from arm_companion.mission.facts import CalibrationState
from arm_companion.transport.urls import open_bus
from arm_companion.workshop.jog import Jog, Key, advance, decode, press, screen

_SHOW_EVERY = 10  # cycles
_FIRST_HEARD_S = 1.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion jog`."""
    parser.epilog = "Limits hold as in flight. At the end the servos hold where they are, with the torque on."
    add_config_arguments(parser)
    parser.add_argument("--speed-deg-s", type=float, default=15.0, metavar="X", help="of the bend (default: 15)")
    parser.add_argument(
        "--torque-off", action="store_true", help="at q, straighten the arm and switch the torque off: it falls limp"
    )


def run(arguments: argparse.Namespace) -> int:
    """Jog until q; exit code 0, 2 when it cannot begin, 1 when a servo or the bus failed."""
    config = load_from(arguments)
    config.check_servos()
    refusal = ""
    if not 0.1 <= arguments.speed_deg_s <= 60.0:
        refusal = f"--speed-deg-s: {arguments.speed_deg_s:g} is not in 0.1 to 60"
    elif config.arm.segments:
        refusal = "arm.segments: keys bend an arm of one segment"
    elif not (sys.stdin.isatty() and sys.stdout.isatty()):
        refusal = "it needs a terminal"
    if refusal:
        print(f"arm-companion jog: {refusal}", file=sys.stderr)
        return 2
    code, last = run_real_time(_jog(config, math.radians(arguments.speed_deg_s), torque_off=arguments.torque_off))
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"arm-companion jog: {last}", file=sys.stderr if code else sys.stdout, flush=True)
    return code


async def _jog(config: Config, speed: float, *, torque_off: bool) -> tuple[int, str]:
    calibrated = Calibrated(config, unix_now())
    bus = ServoBus(
        open_bus(config.servos.port, config.servos.baud),
        calibrated.servos,
        parked=calibrated.parked,
        parked_window=config.calibration.turned_ticks,
    )
    bench = Bench(config, calibrated, bus, speed)
    loop = asyncio.get_running_loop()
    for number in _SIGNALS:
        loop.add_signal_handler(number, bench.end)
    try:
        await bench.start()
        with Keyboard(sys.stdin.fileno(), sys.stdout.fileno(), bench.typed) as keyboard:
            await bench.serve(keyboard)
        if torque_off and bench.asked_to_quit and await bench.straighten():
            await bus.limp()
            return 0, "the arm is limp"
    except* LinkError as errors:
        return_text = "; ".join(str(error) for error in errors.exceptions)
        return_code = 2
    except* (DeviceFault, ArmError) as faults:
        return_text = "; ".join(str(fault) for fault in faults.exceptions)
        return_code = 1
    else:
        return_text, return_code = "the servos hold, with the torque on", 0
    finally:
        for number in _SIGNALS:
            loop.remove_signal_handler(number)
        calibrated.close()
        with contextlib.suppress(ExceptionGroup):
            await bus.stop(limp=False)
    return return_code, return_text


class Bench:
    """The arm under a person's fingers."""

    def __init__(self, config: Config, calibrated: Calibrated, bus: ServoBus, speed: float) -> None:
        self._config = config
        self._calibrated = calibrated
        self._bus = bus
        self._speed = speed
        self._model = RodModel(ArmParameters.of(config.arm))
        self._tendons = Tendons(calibrated.servos, config.limits, config.arm.pulley_radius_m, calibrated.curves)
        self._jog = Jog((0.0, 0.0), (0.0, 0.0), config.limits.bend_max_rad)
        self._typed = b""
        self._ended = asyncio.Event()
        self._note = ""
        self.asked_to_quit = False

    def end(self) -> None:
        """A signal came, or the terminal is gone: stop where the arm is."""
        self._ended.set()

    def typed(self, data: bytes) -> None:
        """Take keys; none at all means that the terminal is gone."""
        if not data:
            self.end()
            return
        keys, self._typed = decode(self._typed + data)
        for key in keys:
            if key is Key.QUIT:
                self.asked_to_quit = True
                self.end()
            self._jog = press(self._jog, key)

    async def start(self) -> None:
        """Open the bus and find the arm as it is.

        Raises:
            LinkError: the port cannot be opened.
            DeviceFault: a servo is not well.
            ExceptionGroup: of such, from several servos.
            ModelError: the arm's bend cannot be told from the servos.
        """
        await self._bus.start()
        until = asyncio.get_running_loop().time() + _FIRST_HEARD_S
        async for tick in ticks(1.0 / self._config.rates.cycle_hz):
            states = await self._bus.read()
            if all(math.isfinite(state.age_s) for state in states) or tick.now > until:
                break
        for state in states:
            if (fault := state.fault) is not None:
                raise fault
        judgement = self._calibrated.judge(self._bus.info, states)
        if judgement.state is not CalibrationState.VALID:
            self._note = judgement.refusal or "no calibration: zeros are the configuration's"
        bend = self._bend(states)
        self._jog = Jog(bend, bend, self._config.limits.bend_max_rad)

    async def serve(self, keyboard: Keyboard) -> None:
        """Follow the keys until the end is asked for."""
        shown = 0
        async for _ in ticks(1.0 / self._config.rates.cycle_hz):
            if self._ended.is_set():
                return
            states = await self._cycle()
            if shown % _SHOW_EVERY == 0:
                keyboard.show(self._screen(states))
            shown += 1

    async def straighten(self) -> bool:
        """Slowly straight; whether it got there, which a signal ends.

        Raises:
            DeviceFault: a servo failed on the way.
        """
        self._ended.clear()
        self._jog = press(self._jog, Key.RELAX)
        async for _ in ticks(1.0 / self._config.rates.cycle_hz):
            for state in await self._cycle():
                if (fault := state.fault) is not None:
                    raise fault
            if self._ended.is_set() or self._jog.bend == self._jog.goal:
                break
        return not self._ended.is_set()

    async def _cycle(self) -> tuple[ServoState, ...]:
        states = await self._bus.read()
        self._tendons.states(states)
        fault = next((state.fault for state in states if state.fault is not None), None)
        if fault is not None:  # the others hold; a tripped watchdog or a lost servo must not be driven on
            self._note = f"{fault}: the servos hold"
            self._jog = press(self._jog, Key.STOP)
            self._tendons.rest()
            return states
        dt = 1.0 / self._config.rates.cycle_hz
        self._jog = advance(self._jog, self._speed, dt)
        pulls = self._model.pull_for_bend(np.asarray(self._jog.bend), self._pretension())
        goals = self._tendons.goals(pulls.tolist(), asyncio.get_running_loop().time())
        await self._bus.write(goals, torque=True)
        return states

    def _pretension(self) -> float:
        """Enough that the outer tendon of the bend keeps its least tension, N."""
        arm = self._model.parameters
        swing = math.hypot(*self._jog.bend) * arm.EI / (2.0 * arm.r * arm.L)
        return max(self._config.arm.tendons.pretension_n, swing + self._config.limits.tension_min_n)

    def _bend(self, states: tuple[ServoState, ...]) -> tuple[float, float]:
        pulls = [tendon.pull for tendon in self._tendons.states(states)]
        x, y = self._model.bend_for_pull(np.asarray(pulls)).tolist()
        return x, y

    def _screen(self, states: tuple[ServoState, ...]) -> str:
        tip: tuple[float, float, float] | None = None
        bend = (math.nan, math.nan)
        with contextlib.suppress(ModelError):
            bend = self._bend(states)
            pulls = np.asarray([tendon.pull for tendon in self._tendons.latest])
            x, y, z = self._model.free(pulls, np.array((0.0, 0.0, GRAVITY))).tip_position.tolist()
            tip = (x, y, z)
        return screen(self._jog, self._tendons.latest, self._tendons.limited, bend, tip, self._note)
