"""Calibrations of the tendons: what is kept of them, and whether one still fits the arm that is there.

An XL430 has no serial number. What identifies it is its id on the bus, its model and its firmware; a twin that was
swapped in with the same three is noticed only by where its horn stands.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from arm_companion import __version__
from arm_companion.arm.tension import LoadCurve
from arm_companion.config.schema import Config, ServosConfig
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.servo_homing import nearest_turn
from arm_companion.drivers.servo_setup import ServoInfo
from arm_companion.drivers.tendons import nominal_curve
from arm_companion.mission.facts import Calibration, CalibrationState
from arm_companion.procedures.tendon_zeros import Found, Zero
from arm_companion.protocol.control_table import TICK_RAD

VERSION = 1
_DAY_S = 86_400.0
_SAME = 1e-9  # relative
_HOME = "arm straight? then CLEAR_ERRORS"


@dataclass(frozen=True, slots=True)
class ServoIdentity:
    """What tells one XL430 from another."""

    id: int
    model: int
    firmware: int

    def __str__(self) -> str:
        return f"servo {self.id} (model {self.model}, firmware {self.firmware})"


@dataclass(frozen=True, slots=True)
class TendonZero:
    """What was found of one tendon."""

    servo: ServoIdentity
    direction: int
    zero_ticks: int  # position at which it holds the straight arm at its pretension
    sigma: float  # m of tendon, one sigma of it
    friction: float  # N at the tendon, of the gears while it ran empty
    temperature: float  # degC of the servo


@dataclass(frozen=True, slots=True)
class TendonCalibration:
    """Zeros of all tendons, with what they depend on."""

    version: int
    made_unix_s: float
    made: str  # the same as a date, UTC
    program: str  # version that made it
    pulley_radius: float  # m
    pretension: float  # N
    angles_deg: tuple[float, ...]
    coupling: tuple[tuple[float, ...], ...]
    tendons: tuple[TendonZero, ...]


@dataclass(frozen=True, slots=True)
class Progress:
    """What an interrupted calibration on the bench has found, while the servos keep counting."""

    version: int
    made_unix_s: float
    servos: tuple[ServoIdentity, ...]
    pulley_radius: float  # m
    stood: tuple[int, ...]  # ticks of each servo where the run began, and where every end of it but the hardest left it
    found: tuple[Found, ...]


@dataclass(frozen=True, slots=True)
class TensionFit:
    """Load to tension of one servo, as measured with known tensions."""

    servo: ServoIdentity
    made_unix_s: float
    pulley_radius: float  # m
    curve: LoadCurve
    scatter: float  # N, of the readings about the curve
    readings: int


@dataclass(frozen=True, slots=True)
class TensionCalibration:
    """The fits of those servos that were measured."""

    version: int
    fits: tuple[TensionFit, ...]


def made_of(
    zeros: Sequence[Zero], servos: tuple[ServoIdentity, ...], config: Config, unix_s: float
) -> TendonCalibration:
    """The calibration to be kept.

    Args:
        zeros: as found, in the tendons' order, in the servos' own ticks.
        servos: that are there.
        config: what they depend on.
        unix_s: Unix time now.
    """
    return TendonCalibration(
        VERSION,
        unix_s,
        datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="seconds"),
        __version__,
        config.arm.pulley_radius_m,
        config.arm.tendons.pretension_n,
        config.arm.tendons.angles_deg,
        config.servos.coupling,
        tuple(
            TendonZero(servo, direction, zero.ticks, zero.sigma, zero.friction, zero.temperature)
            for servo, direction, zero in zip(servos, config.servos.directions, zeros, strict=True)
        ),
    )


def misfit(calibration: TendonCalibration, config: Config) -> str:
    """Why a calibration cannot be meant for this configuration; empty when it can."""
    servos, arm = config.servos, config.arm
    ids = tuple(tendon.servo.id for tendon in calibration.tendons)
    if ids != servos.ids:
        return f"it is of servos {list(ids)}, the configuration has {list(servos.ids)}"
    if not _same((calibration.pulley_radius,), (arm.pulley_radius_m,)):
        was, now = calibration.pulley_radius * 1e3, arm.pulley_radius_m * 1e3
        return f"the pulleys' radius was {was:g} mm and is {now:g} mm"
    if not _same((calibration.pretension,), (arm.tendons.pretension_n,)):
        return f"the pretension was {calibration.pretension:g} N and is {arm.tendons.pretension_n:g} N"
    if not _same(calibration.angles_deg, arm.tendons.angles_deg):
        return "the tendons' angles are others"
    if calibration.coupling != servos.coupling:
        return "the tendons' coupling is another"
    for i, (tendon, direction) in enumerate(zip(calibration.tendons, servos.directions, strict=True)):
        if tendon.direction != direction:
            return f"the direction of tendon {i + 1} was {tendon.direction:+d} and is {direction:+d}"
    return ""


def stranger(calibration: TendonCalibration, found: Mapping[int, ServoInfo]) -> str:
    """Which servo is another than at the calibration; empty when all that were found are the same."""
    for i, tendon in enumerate(calibration.tendons):
        info = found.get(tendon.servo.id)
        if info is not None and (now := identity(info)) != tendon.servo:
            return f"tendon {i + 1} was calibrated with {tendon.servo}, and there is {now}"
    return ""


def turned(servos: Sequence[ServoState], parked: Mapping[int, int]) -> str:
    """Which servo came back from a loss of power without knowing its turns; empty when none did."""
    for i, servo in enumerate(servos):
        if not servo.turns_lost:
            continue
        if servo.id not in parked:
            return f"servo {servo.id} (tendon {i + 1}) has lost its turns ({_HOME})"
        by = nearest_turn(servo.position, parked[servo.id]) - parked[servo.id]
        return f"servo {servo.id} (tendon {i + 1}) was turned by {by} ticks without power ({_HOME})"
    return ""


def judge(
    calibration: TendonCalibration | str,
    config: Config,
    found: Mapping[int, ServoInfo],
    servos: Sequence[ServoState],
    parked: Mapping[int, int],
) -> Calibration:
    """Whether the arm may fly on a calibration.

    Args:
        calibration: what was read; a text says why there is none to be used, an empty one that there is none.
        config: as configured.
        found: servos set up so far, by id.
        servos: their states.
        parked: where servos last stood while they were known, ticks by id.
    """
    sigma = config.servos.zero_sigma_m
    if isinstance(calibration, str):
        if calibration:
            return Calibration(CalibrationState.STALE, f"calibration of the tendons: {calibration}", sigma)
        needed = config.calibration.tendons == "required"
        refusal = "no calibration of the tendons: run `arm-companion calibrate tendons`" if needed else ""
        return Calibration(CalibrationState.MISSING, refusal, sigma)
    sigma = max(tendon.sigma for tendon in calibration.tendons)
    why = misfit(calibration, config) or stranger(calibration, found) or turned(servos, parked)
    if why:
        return Calibration(CalibrationState.STALE, f"the calibration does not fit: {why}", sigma)
    if any(servo_id not in found for servo_id in config.servos.ids):
        return Calibration(CalibrationState.UNKNOWN, "", sigma)
    return Calibration(CalibrationState.VALID, "", sigma)


def too_old(calibration: TendonCalibration, config: Config, unix_s: float) -> str:
    """A warning when a calibration is older than it should be."""
    days = (unix_s - calibration.made_unix_s) / _DAY_S
    limit = config.calibration.max_age_days
    return f"the calibration of the tendons is {days:.0f} days old, over {limit:g}" if days > limit else ""


def apply(calibration: TendonCalibration, servos: ServosConfig) -> ServosConfig:
    """The servos' configuration with a calibration's zeros; one for other servos changes nothing."""
    if tuple(tendon.servo.id for tendon in calibration.tendons) != servos.ids:
        return servos
    return dataclasses.replace(
        servos,
        zero_ticks=tuple(tendon.zero_ticks for tendon in calibration.tendons),
        zero_sigma_m=max(tendon.sigma for tendon in calibration.tendons),
    )


def curves(calibration: TensionCalibration | None, config: Config) -> tuple[tuple[LoadCurve, ...], list[str]]:
    """From load to tension for each servo, and why a measured curve is not used.

    Firmware is not known before the bus is open; `arm-companion calibrate tension` measures again after an update.
    """
    nominal = nominal_curve(config.servos, config.arm.pulley_radius_m)
    fits = {fit.servo.id: fit for fit in calibration.fits} if calibration is not None else {}
    found, refused = [], []
    for servo in config.servos.ids:
        fit = fits.get(servo)
        if fit is not None and not _same((fit.pulley_radius,), (config.arm.pulley_radius_m,)):
            refused.append(f"tension of servo {servo} was measured with a pulley of {fit.pulley_radius * 1e3:g} mm")
            fit = None
        found.append(nominal if fit is None else fit.curve)
    return tuple(found), refused


def identity(info: ServoInfo) -> ServoIdentity:
    """What identifies a servo that was set up."""
    return ServoIdentity(info.id, info.model, info.firmware)


def ticks_of(length: float, pulley_radius: float) -> float:
    """Ticks that wind up `length` m on a pulley."""
    return length / (pulley_radius * TICK_RAD)


def _same(one: Sequence[float], other: Sequence[float]) -> bool:
    return len(one) == len(other) and all(math.isclose(a, b, rel_tol=_SAME) for a, b in zip(one, other, strict=True))
