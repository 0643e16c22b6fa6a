"""What the daemon does for a calibration that the mission carries out: it winds, stores, and takes into use."""

import dataclasses
import logging
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from pathlib import Path

from arm_companion.config.schema import Config, LimitsConfig
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibrated import Calibrated
from arm_companion.drivers.calibration import TendonCalibration, identity, made_of
from arm_companion.drivers.servo_bus import ServoBus
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.tendons import Tendons
from arm_companion.drivers.writer import Writer
from arm_companion.errors import DeviceFault
from arm_companion.last_writes import Ending, wait_for
from arm_companion.mission.facts import Order, Request, Workshop
from arm_companion.mission.state import CALIBRATES, Phase
from arm_companion.procedures.tendon_zeros import Zero
from arm_companion.protocol.control_table import TICK_RAD

_log = logging.getLogger(__name__)


class Recalibration:
    """One calibration at a time.

    Args:
        config: as configured; only limits may change.
        calibrated: what is flown on, and is replaced by a result.
        bus: learns of new zeros.
        on_renewed: called when `calibrated` has another calibration.
    """

    def __init__(
        self, config: Config, calibrated: Calibrated, bus: ServoBus, on_renewed: Callable[[], None] = lambda: None
    ) -> None:
        self._config = config
        self._calibrated = calibrated
        self._bus = bus
        self._on_renewed = on_renewed
        self._servos: Sequence[ServoState] = ()
        self._winding: Tendons | None = None
        self._shift: tuple[float, ...] = ()  # m, pull of each tendon where the winding began
        self._writer: Writer | None = None
        self._writing: Future[None] | None = None
        self._made: TendonCalibration | None = None
        self._kept: str | None = None

    def facts(self, servos: Sequence[ServoState], requests: Iterable[Request], phase: Phase) -> Workshop | None:
        """What the mission must know, once a cycle; a result that has been stored is in use from here on.

        Args:
            servos: as just heard.
            requests: of this cycle.
            phase: after the last step.
        """
        self._servos = servos
        if phase not in CALIBRATES:
            self._winding = None
        if self._writing is not None and self._writing.done():
            self._finish(self._writing, wanted=phase is Phase.CALIBRATING)
        asked = phase in CALIBRATES or any(request.order is Order.CALIBRATE for request in requests)
        if not asked or not self._config.calibration.directory:
            return None
        return Workshop(self._calibrated.curves, TICK_RAD * self._config.arm.pulley_radius_m, self._kept)

    def goals(self, pulls: Sequence[float], limits: LimitsConfig, now: float) -> tuple[int, ...]:
        """Servo positions for goals of a calibration, within the limits, which count from where the winding began.

        Slack is what a calibration begins with, so nothing keeps a tendon from it.

        Args:
            pulls: m for each tendon, from the zeros that are in use.
            limits: on displacement, speed and tension.
            now: loop time, s.
        """
        servos, radius = self._calibrated.servos, self._config.arm.pulley_radius_m
        if self._winding is None:
            origin = tuple(servo.position for servo in self._servos)
            self._winding = Tendons(
                dataclasses.replace(servos, zero_ticks=origin),
                dataclasses.replace(limits, tension_min_n=0.0),
                radius,
                self._calibrated.curves,
            )
            self._shift = tuple(-self._winding.wound(i, zero) for i, zero in enumerate(servos.zero_ticks))
        self._winding.states(self._servos)
        wound = [pull - shift for pull, shift in zip(pulls, self._shift, strict=True)]
        return self._winding.goals(wound, now)

    def store(self, zeros: Sequence[Zero], unix_s: float) -> None:
        """Begin to store a result, which the mission has found in ticks from the zeros that are in use.

        Args:
            zeros: in the tendons' order.
            unix_s: Unix time now.
        """
        servos = self._calibrated.servos
        there = [
            dataclasses.replace(zero, ticks=old + zero.ticks)
            for old, zero in zip(servos.zero_ticks, zeros, strict=True)
        ]
        known = tuple(identity(self._bus.info[servo]) for servo in servos.ids)
        self._made, self._kept = made_of(there, known, self._config, unix_s), None
        self._writer = self._writer or Writer("calibration")
        self._writing = self._writer.submit(files.save, self._file, self._made)

    async def let_go(self) -> None:
        """Torque off. What does not obey shows in the servos' states."""
        try:
            await self._bus.limp()
        except* DeviceFault as faults:
            _log.debug("torque off: %s", faults.exceptions)

    def end(self) -> list[Ending]:
        """What is being written, to be waited for."""
        return [] if self._writer is None else self._writer.end()

    def close(self) -> None:
        """Wait for what is being written, but not for a disk that hangs."""
        wait_for(self.end())

    @property
    def _file(self) -> Path:
        return Path(self._config.calibration.directory) / files.TENDONS

    def _finish(self, writing: "Future[None]", *, wanted: bool) -> None:
        """Take a result into use; one that came after the calibration was given up is taken back."""
        made, self._writing, self._made = self._made, None, None
        error = writing.exception()
        if error is not None:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self._kept = f"{self._file} cannot be written: {reason}"
        elif made is None or not wanted:
            self._put_back()
        else:
            self._calibrated.renew(made)
            self._bus.renew_zeros(self._calibrated.servos.zero_ticks)
            self._on_renewed()
            self._kept = ""

    def _put_back(self) -> None:
        """The file of the calibration that is in force, as it was before."""
        former = self._calibrated.stored
        _log.warning("a calibration that was given up is taken back from %s", self._file)
        if self._writer is None:
            return
        if former is None:
            self._writer.submit(self._file.unlink, missing_ok=True)
        else:
            self._writer.submit(files.save, self._file, former)
