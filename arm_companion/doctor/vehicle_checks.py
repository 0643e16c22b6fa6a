"""Checks of the autopilot and the link to it, from a few seconds of listening."""

from collections.abc import Callable, Iterator
from typing import Final

from arm_companion.config.schema import Config
from arm_companion.doctor.check import Check, Outcome, fail, ok, skipped, warn
from arm_companion.doctor.machine_checks import no_config
from arm_companion.doctor.subject import Subject, VehicleSeen
from arm_companion.drivers.vehicle_expectations import Finding, judge, judge_rates, names

_LOSS_SHARE: Final = 0.02
_ENOUGH: Final = 0.5  # of an asked rate: PX4 gives 124 Hz where 200 are asked
_CLOCK_ERROR_S: Final = 0.02
_FORWARDS: Final = ("FORWARD", "OPTIONS")


def _seen(look: Callable[[Config, VehicleSeen], Iterator[Outcome]]) -> Callable[[Subject], Iterator[Outcome]]:
    """A check that needs an autopilot that was heard."""

    def checked(subject: Subject) -> Iterator[Outcome]:
        seen = subject.vehicle
        if subject.config is None:
            yield no_config(subject)
        elif isinstance(seen, str):
            yield skipped(seen)
        elif not seen.system_id:
            yield skipped("the autopilot was not heard")
        else:
            yield from look(subject.config, seen)

    return checked


def link(subject: Subject) -> Iterator[Outcome]:
    """Whether the autopilot is heard, whole and often enough."""
    seen, config = subject.vehicle, subject.config
    if config is None:
        yield no_config(subject)
    elif isinstance(seen, str):
        yield skipped(seen)
    elif seen.error:
        yield fail(seen.error, "check cable, device and links.*.url; `ls -l /dev/serial/by-id`; groups of the user")
    elif not seen.system_id:
        yield _silence(seen)
    else:
        if not seen.fits:
            yield fail(f"the autopilot is no {config.vehicle.autopilot}", "set vehicle.autopilot to what it is")
        total = seen.frames + seen.lost
        if seen.lost > _LOSS_SHARE * total:
            yield warn(f"{seen.lost} of {total} frames were lost", "a shorter cable, flow control, or a higher baud")
        slow = {name: rates for name, rates in seen.rates_hz.items() if rates[1] < _ENOUGH * rates[0]}
        yield from map(_outcome, judge_rates(slow))
        rates = ", ".join(f"{name} {got:.0f} Hz" for name, (_, got) in seen.rates_hz.items())
        yield ok(f"system {seen.system_id}, {total} frames, {seen.lost} lost; {rates}")


def _silence(seen: VehicleSeen) -> Outcome:
    if seen.refused:
        return fail(f"{seen.refused} frames came without our signature", "give both ends the same signing key")
    if seen.frames:
        return fail("MAVLink comes, and no autopilot's heartbeat", "connect the link to the autopilot itself")
    if seen.received_bytes:
        return fail(
            f"{seen.received_bytes} bytes came, none of them MAVLink 2",
            "set the same baud on both ends, and MAVLink 2 on the autopilot's port",
        )
    return fail("nothing comes", "check power, RX and TX crossed, and that MAVLink is enabled on the autopilot's port")


def _outcome(finding: Finding) -> Outcome:
    return warn(finding.what, finding.mend)


def _judged(config: Config, seen: VehicleSeen, *, forwarding: bool) -> list[Finding]:
    found = judge(config.vehicle.autopilot, config.mavlink.vehicle_instance, seen.parameters)
    return [finding for finding in found if finding.about.endswith(_FORWARDS) == forwarding]


@_seen
def parameters(config: Config, seen: VehicleSeen) -> Iterator[Outcome]:
    """The autopilot's settings, forwarding aside."""
    if not seen.parameters:
        yield warn("the autopilot answers no parameter request", "let it take commands from this computer's ids")
        return
    yield from map(_outcome, _judged(config, seen, forwarding=False))
    yield ok(", ".join(f"{name} = {value:g}" for name, value in seen.parameters.items()))


@_seen
def forwarding(config: Config, seen: VehicleSeen) -> Iterator[Outcome]:
    """Whether a ground station reaches the arm through the autopilot."""
    if seen.stations:
        listed = ", ".join(map(str, seen.stations))
        yield ok(f"ground station {listed} is heard through the autopilot")
        return
    yield from map(_outcome, _judged(config, seen, forwarding=True))
    wanted = names(config.vehicle.autopilot, config.mavlink.vehicle_instance)
    if any(name in seen.parameters for name in wanted if name.endswith(_FORWARDS)):
        yield ok("the autopilot's port forwards; no ground station was heard through it")
    else:
        yield skipped("the autopilot has no such parameter, and no ground station was heard through it")


@_seen
def vehicle_clock(_: Config, seen: VehicleSeen) -> Iterator[Outcome]:
    """How well the autopilot's clock is known."""
    if seen.clock_error_s > _CLOCK_ERROR_S:
        known = "it answers no TIMESYNC" if seen.clock_error_s == float("inf") else f"{seen.clock_error_s * 1e3:.0f} ms"
        yield warn(f"autopilot's clock: {known}", "a link with a shorter round trip; TIMESYNC on the autopilot's port")
    else:
        yield ok(f"known to {seen.clock_error_s * 1e3:.1f} ms")


CHECKS: Final = (
    Check("link", "without the vehicle's state the arm may not move", link),
    Check("autopilot parameters", "they decide what the vehicle does when set-points stop", parameters),
    Check("forwarding", "ground stations that hear the autopilot alone reach the arm only through it", forwarding),
    Check("autopilot clock", "states of unknown age are taken for older than they are", vehicle_clock),
)
