"""Checks of the arm: servos, their supply, and the calibration of its tendons."""

from collections.abc import Iterator
from typing import Final

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import Config
from arm_companion.doctor.check import Check, Outcome, fail, ok, skipped, warn
from arm_companion.doctor.machine_checks import no_config
from arm_companion.doctor.subject import ServosSeen, Subject
from arm_companion.drivers import calibration_files
from arm_companion.drivers.calibration import TendonCalibration, curves, misfit, too_old
from arm_companion.mission.parameters import Parameters

_LOSS_SHARE: Final = 0.01
_MARGIN_V: Final = 0.5
_LATENCY_SHARE: Final = 0.5  # of servos.reply_timeout_s
_WARM_C: Final = 10.0  # below the limit
_THROTTLED: Final = "sys/devices/platform/soc/soc:firmware/get_throttled"
_UNDER_VOLTAGE_NOW: Final = 0x1
_UNDER_VOLTAGE_ONCE: Final = 0x10000


def servos(subject: Subject) -> Iterator[Outcome]:
    """Whether each servo answers, and what it complains of."""
    seen, config = subject.servos, subject.config
    if config is None:
        yield no_config(subject)
    elif isinstance(seen, str):
        yield skipped(seen)
    elif seen.error:
        yield fail(seen.error, "check the adapter, servos.port, and the groups of the user")
    else:
        yield from _servos(config, seen)


def _servos(config: Config, seen: ServosSeen) -> Iterator[Outcome]:
    silent = [servo.id for servo in seen.servos if servo.silent]
    if silent:
        every = "no servo answers" if len(silent) == len(seen.servos) else f"servo {_listed(silent)} is silent"
        yield fail(
            every, "switch the servos' supply on; check the cable; `arm-companion servos scan` finds ids and speeds"
        )
    for servo in seen.servos:
        if servo.error_bits:
            yield fail(str(servo.fault), "remove the cause, then CLEAR_ERRORS or switch the servos off and on")
        elif servo.temperature > config.servos.temperature_limit_c - _WARM_C:
            yield warn(f"servo {servo.id} has {servo.temperature:.0f} degC", "let it cool; look for a tendon that jams")
    total = seen.answers + seen.lost
    if not silent and total and seen.lost > _LOSS_SHARE * total:
        yield warn(f"{seen.lost} of {total} requests were lost", "shorter cables, a common ground, a lower baud")
    if seen.latency_s > _LATENCY_SHARE * config.servos.reply_timeout_s:
        yield warn(
            f"an answer takes {seen.latency_s * 1e3:.1f} ms beyond its bytes, over half of servos.reply_timeout_s",
            "see the check of the latency timer",
        )
    yield ok(f"servos {_listed([servo.id for servo in seen.servos])} answer, {seen.lost} of {total} requests lost")


def voltage(subject: Subject) -> Iterator[Outcome]:
    """The servos' supply, and this computer's where it tells."""
    if (throttled := subject.machine.text(_THROTTLED)) is not None:
        bits = int(throttled, 16)
        if bits & _UNDER_VOLTAGE_NOW:
            yield fail("this computer's supply is too low now", "a supply with more current, a shorter cable")
        elif bits & _UNDER_VOLTAGE_ONCE:
            yield warn("this computer's supply was too low since it booted", "a supply with more current")
    seen, config = subject.servos, subject.config
    if config is None:
        yield no_config(subject)
    elif isinstance(seen, str) or seen.error:
        yield skipped(seen if isinstance(seen, str) else "the servo bus cannot be opened")
    elif not (volts := [servo.voltage for servo in seen.servos if not servo.silent]):
        yield skipped("no servo answers")
    else:
        yield _voltage(config, min(volts), max(volts))


def _voltage(config: Config, lowest: float, highest: float) -> Outcome:
    lower, upper = config.servos.voltage_min_v, config.servos.voltage_max_v
    text = f"{lowest:.1f} to {highest:.1f} V at the servos, {lower:g} to {upper:g} V allowed"
    if lowest < lower or highest > upper:
        return fail(text, "charge or change the battery; check the regulator")
    if lowest < lower + _MARGIN_V:
        return warn(text, "charge the battery: the supply sags further under load")
    return ok(text)


def calibration(subject: Subject) -> Iterator[Outcome]:
    """Whether there is one, whole, of this arm, and not too old."""
    config = subject.config
    if config is None:
        yield no_config(subject)
        return
    again = "run `arm-companion calibrate tendons`"
    found = calibration_files.tendons(config.calibration.directory)
    if isinstance(found, str):
        if found:
            yield fail(found, again)
        elif config.calibration.tendons == "required":
            yield fail("there is none, and calibration.tendons is required", again)
        else:
            yield warn("there is none: the zeros are the configuration's", f"{again}, with calibration.directory set")
        return
    if why := misfit(found, config):
        yield fail(f"it does not fit: {why}", again)
    yield from _against_servos(found, subject.servos)
    if old := too_old(found, config, subject.machine.unix_s):
        yield warn(old, again)
    try:
        _, refused = curves(calibration_files.tension(config.calibration.directory), config)
    except ValueError as error:
        refused = [f"tensions as configured: {error}"]
    for reason in refused:
        yield warn(reason, "run `arm-companion calibrate tension`")
    yield ok(f"made {found.made} by version {found.program}")


def _against_servos(found: TendonCalibration, seen: ServosSeen | str) -> Iterator[Outcome]:
    if isinstance(seen, str):
        return
    for tendon in found.tendons:
        for servo, firmware in zip(seen.servos, seen.firmware, strict=False):
            if servo.id == tendon.servo.id and firmware not in (0, tendon.servo.firmware):
                yield fail(
                    f"servo {servo.id} has firmware {firmware}, and had {tendon.servo.firmware} when calibrated",
                    "was it exchanged? run `arm-companion calibrate tendons`",
                )


def keep_out(subject: Subject) -> Iterator[Outcome]:
    """Whether there is a cone that keeps the arm from the propellers, and room for the full wrap beside it."""
    config = subject.config
    if config is None:
        yield no_config(subject)
        return
    if not config.limits.keep_out.half_angle_deg:
        yield warn(
            "there is no cone: limits.bend_max_rad and the mount alone keep the arm away",
            "measure where propellers and landing gear are, and set limits.keep_out",
        )
        return
    clearance = Parameters(config, RodModel(ArmParameters.of(config.arm))).wrap_clearance
    if clearance < 0.0:
        yield fail(
            f"the full wrap is {-clearance * 100:.1f} cm inside the cone, so PERCH and GRASP are refused",
            "a longer mount, a smaller perch.wrap_bend_rad, or a cone that fits the airframe",
        )
    else:
        yield ok(f"the full wrap stays {clearance * 100:.1f} cm away from it")


def _listed(ids: list[int]) -> str:
    return ", ".join(map(str, ids))


CHECKS: Final = (
    Check("servos", "each of them holds one tendon; an arm with one less cannot be commanded", servos),
    Check("voltage", "servos that are short of voltage shut down while they hold the vehicle", voltage),
    Check("keep-out cone", "an arm that curls into a propeller is the end of the flight", keep_out),
    Check("calibration", "without zeros of its own the arm bends elsewhere than it is told", calibration),
)
