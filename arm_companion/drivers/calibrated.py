"""The calibration that the daemon flies with: read once at start, applied over the configuration, judged all along."""

from collections.abc import Mapping, Sequence

from arm_companion.config.schema import Config
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers.calibration import TendonCalibration, apply, curves, judge, misfit, too_old
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.servo_setup import ServoInfo
from arm_companion.drivers.tendons import Tendons
from arm_companion.last_writes import Ending, wait_for
from arm_companion.mission.facts import Calibration


class Calibrated:
    """What the state directory says, for one run of the daemon.

    Attributes:
        servos: the servos' configuration with calibrated zeros.
        curves: from load to tension, for each servo.
        parked: where servos last stood, ticks by id.
        warnings: what people should know and what does not keep the arm on the ground.
    """

    def __init__(self, config: Config, unix_s: float) -> None:
        """Read the directory that `config` names.

        Args:
            config: as configured.
            unix_s: Unix time now, for the calibration's age.
        """
        directory = config.calibration.directory
        self._config = config
        self._tendons = files.tendons(directory)
        self.parked = files.parked(directory)
        self.servos = config.servos
        self.warnings: list[str] = []
        if isinstance(self._tendons, TendonCalibration) and not misfit(self._tendons, config):
            self.servos = apply(self._tendons, config.servos)
            if old := too_old(self._tendons, config, unix_s):
                self.warnings.append(old)
        try:
            tension = files.tension(directory)
        except ValueError as error:
            tension = None
            self.warnings.append(f"tensions as configured: {error}")
        self.curves, refused = curves(tension, config)
        self.warnings += refused
        self._log = files.ParkingLog(directory, self.parked)
        self._servos: Sequence[ServoState] = ()
        self._key: object = None
        self._judgement = Calibration()

    def judge(self, found: Mapping[int, ServoInfo], servos: Sequence[ServoState]) -> Calibration:
        """Whether the arm may fly on it; called once a cycle.

        Args:
            found: servos set up so far, by id.
            servos: their states.
        """
        self._servos = servos
        self._log.note(servos)
        key = (tuple(found.values()), tuple([servo.id for servo in servos if servo.turns_lost]))
        if key != self._key:
            self._key = key
            self._judgement = judge(self._tendons, self._config, found, servos, self.parked)
        return self._judgement

    @property
    def stored(self) -> TendonCalibration | None:
        """The tendons' calibration that the directory has; None: none that can be used."""
        return self._tendons if isinstance(self._tendons, TendonCalibration) else None

    def renew(self, calibration: TendonCalibration) -> None:
        """Go on with another calibration of the tendons, which has been stored."""
        self._tendons = calibration
        self.servos = apply(calibration, self._config.servos)
        self._key = None

    def tendons(self, config: Config) -> Tendons:
        """The tendons as calibrated, within the limits of `config`, which a parameter can change."""
        return Tendons(self.servos, config.limits, config.arm.pulley_radius_m, self.curves)

    def end(self) -> list[Ending]:
        """Have it kept where the servos stand; nothing waits here."""
        return self._log.end(self._servos)

    def close(self) -> None:
        """Keep where the servos stand."""
        wait_for(self.end())
