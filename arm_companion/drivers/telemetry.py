"""Telemetry: what the arm does, feels and predicts, as messages of the dialect at each link's rates."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final, TypeVar

import numpy as np

from arm_companion.clock import Clock
from arm_companion.config.schema import RatesConfig
from arm_companion.drivers.link_watch import LinkWatch
from arm_companion.drivers.mavlink_link import MavlinkLink, Priority
from arm_companion.drivers.mirrors import mirror_array, mirror_values
from arm_companion.mission.facts import (
    PayloadReport,
    StatusReport,
    StiffnessReport,
    TendonState,
    TensionEstimate,
    WrenchReport,
    WrenchSource,
)
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

STATUS: Final = mav.MAVLINK_MSG_ID_ARM_STATUS
TENDONS: Final = mav.MAVLINK_MSG_ID_ARM_TENDONS
WRENCH: Final = mav.MAVLINK_MSG_ID_ARM_REACTION_WRENCH

STIFFNESS: Final = mav.MAVLINK_MSG_ID_ARM_STIFFNESS
PAYLOAD: Final = mav.MAVLINK_MSG_ID_ARM_PAYLOAD
VALUES: Final = mav.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT
ARRAY: Final = mav.MAVLINK_MSG_ID_DEBUG_FLOAT_ARRAY
NODE: Final = mav.MAVLINK_MSG_ID_LINK_NODE_STATUS
COMPUTER: Final = mav.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS

PER_MESSAGE: Final = 4
"""Tendons that fit into one ARM_TENDONS."""

_BEHAVIOURS: Final = {
    entry.name.removeprefix("ARM_BEHAVIOUR_"): value for value, entry in mav.enums["ARM_BEHAVIOUR"].items()
}
Number = TypeVar("Number", int, float)

_UPPER: Final = np.triu_indices(6)
_WELL_CONDITIONED: Final = 1e9

_INT16_MAX: Final = 32_767
_UINT16_MAX: Final = 65_535
_UINT8_MAX: Final = 255

# Hardware-error bits of a servo and the errors of the arm that they mean.
_SERVO_ERRORS: Final = (
    (0x01, mav.ARM_ERROR_LOW_VOLTAGE),
    (0x04, mav.ARM_ERROR_OVERHEAT),
    (0x20, mav.ARM_ERROR_OVERLOAD),
)
_SOURCE_FLAGS: Final = {
    WrenchSource.FREE: 0,
    WrenchSource.CONTACT: mav.ARM_FLAG_CONTACT,
    WrenchSource.ANCHORED: mav.ARM_FLAG_CONTACT | mav.ARM_FLAG_ANCHORED,
    WrenchSource.PAYLOAD: mav.ARM_FLAG_PAYLOAD,
}


class Telemetry:
    """Sends what is due on each link.

    Args:
        links: all links; each has its own rates, which SET_MESSAGE_INTERVAL changes.
        rates: rates at the start.
        clock: Unix time of the stamps.
        computer: makes ONBOARD_COMPUTER_STATUS for a stamp; None: nobody watches the computer.
    """

    def __init__(
        self,
        links: Sequence[MavlinkLink],
        rates: RatesConfig,
        clock: Clock,
        computer: Callable[[int], Message] | None = None,
    ) -> None:
        self._links = links
        self._clock = clock
        self._computer = computer
        self.holder: tuple[int, int] = (0, 0)
        """Who has primary control, for ARM_STATUS."""
        self._nodes = {link.name: LinkWatch(link) for link in links}
        for link in links:
            for id_, rate in _rates(rates, link):
                link.streams.offer(id_, rate)

    def set_rates(self, rates: RatesConfig) -> None:
        """Other default rates, for who has not asked for his own."""
        for link in self._links:
            for id_, rate in _rates(rates, link):
                link.streams.set_default(id_, rate)

    def publish(
        self,
        now: float,
        status: StatusReport,
        tendons: Sequence[TendonState],
        wrench: WrenchReport,
        goals: Sequence[float] | None = None,
        *,
        tensions: Sequence[TensionEstimate] = (),
        stiffness: StiffnessReport | None = None,
        payload: PayloadReport | None = None,
    ) -> None:
        """Send whichever messages are due; called once a cycle.

        Args:
            now: loop time, s.
            status: what the arm does. Flags and errors that tendons and wrench show are added to its own.
            tendons: state of each tendon.
            wrench: predicted reaction wrench.
            goals: commanded displacement of each tendon, m; None when there is none.
            tensions: estimates that replace those which the loads alone give; none when empty.
            stiffness: of the arm in its pose; None when the model has none.
            payload: what it carries; None when nothing is estimated.
        """
        stamp = round(self._clock.unix(now) * 1e6)
        boot_ms = int(now * 1e3) & 0xFFFFFFFF
        self._offer(STATUS, now, lambda: iter((status_message(stamp, status, tendons, wrench, self.holder),)))
        self._offer(TENDONS, now, lambda: tendon_messages(stamp, tendons, goals, tensions))
        self._offer(WRENCH, now, lambda: iter((wrench_message(stamp, wrench),)))
        if stiffness is not None:
            self._offer(STIFFNESS, now, lambda: stiffness_messages(stamp, stiffness))
        if payload is not None:
            self._offer(PAYLOAD, now, lambda: iter((payload_message(stamp, payload),)))
        self._offer(VALUES, now, lambda: mirror_values(boot_ms, status, tendons, wrench))
        self._offer(ARRAY, now, lambda: iter((mirror_array(stamp, status, tendons, wrench),)))
        if (computer := self._computer) is not None:
            self._offer(COMPUTER, now, lambda: iter((computer(stamp),)))
        for link in self._links:
            if link.connected and link.streams.take_due(NODE, now):
                link.send(self._nodes[link.name].message(now), Priority.BULK)

    def _offer(self, id_: int, now: float, make: Callable[[], Iterator[Message]]) -> None:
        """Make the messages once, if any link has them due, and send them there."""
        due = [link for link in self._links if link.connected and link.streams.take_due(id_, now)]
        if due:
            for message in make():
                for link in due:
                    link.send(message, Priority.BULK)


def _rates(rates: RatesConfig, link: MavlinkLink) -> Iterator[tuple[int, float]]:
    """Ids with their default rates on a link."""
    mirrors = rates.mirrors_hz if link.mirrors else 0.0
    for id_, rate in (
        (STATUS, rates.status_hz),
        (TENDONS, rates.tendons_hz),
        (WRENCH, rates.wrench_hz),
        (STIFFNESS, rates.stiffness_hz),
        (PAYLOAD, rates.payload_hz),
        (VALUES, mirrors),
        (ARRAY, mirrors),
        (NODE, 0.0),
        (COMPUTER, rates.computer_hz),
    ):
        yield id_, link.config.rates_hz.get(mav.mavlink_map[id_].msgname, rate)


def status_message(
    stamp: int,
    status: StatusReport,
    tendons: Sequence[TendonState],
    wrench: WrenchReport,
    holder: tuple[int, int] = (0, 0),
) -> Message:
    """ARM_STATUS.

    Args:
        stamp: Unix time, us.
        status: what the mission reports.
        tendons: they tell of the servos.
        wrench: its source tells of contact.
        holder: system and component that have primary control; zeros: nobody.
    """
    flags, errors = status.flags | _SOURCE_FLAGS[wrench.source], status.error_bits
    if tendons and not any(t.silent for t in tendons):
        flags |= mav.ARM_FLAG_SERVOS_CONNECTED
    if tendons and all(t.torque for t in tendons):
        flags |= mav.ARM_FLAG_TORQUE_ON
    for tendon in tendons:
        errors |= mav.ARM_ERROR_SERVO_SILENT if tendon.silent else 0
        errors |= mav.ARM_ERROR_SERVO_FAULT if tendon.error_bits else 0
        for bit, error in _SERVO_ERRORS:
            errors |= error if tendon.error_bits & bit else 0
    return mav.MAVLink_arm_status_message(
        stamp,
        flags,
        errors,
        status.theta,
        status.delta,
        list(status.tip_position_a),
        status.goal_theta,
        status.goal_delta,
        _BEHAVIOURS.get(status.behaviour.upper(), mav.ARM_BEHAVIOUR_UNKNOWN),
        status.state_number,
        status.progress,
        int(status.calibration),
        status.state.encode("ascii", errors="replace")[:20],
        *holder,
    )


def wrench_message(stamp: int, wrench: WrenchReport) -> Message:
    """ARM_REACTION_WRENCH.

    Args:
        stamp: Unix time, us.
        wrench: about the airframe's centre of mass, body axes.
    """
    return mav.MAVLink_arm_reaction_wrench_message(
        stamp,
        list(wrench.force_b),
        list(wrench.torque_b),
        list(wrench.force_sigma),
        list(wrench.torque_sigma),
        wrench.taut_margin,
        wrench.residual,
        int(wrench.source),
        mav.ARM_VALIDITY_FORCE | mav.ARM_VALIDITY_TORQUE if wrench.valid else 0,
    )


def stiffness_messages(stamp: int, stiffness: StiffnessReport) -> Iterator[Message]:
    """ARM_STIFFNESS: the compliance, and its inverse where there is one.

    Args:
        stamp: Unix time, us.
        stiffness: the compliance' upper triangle.
    """
    entries = list(stiffness.compliance_b)
    yield mav.MAVLink_arm_stiffness_message(stamp, entries, mav.ARM_MATRIX_COMPLIANCE)
    C = np.zeros((6, 6))
    C[_UPPER] = entries
    C = C + np.triu(C, 1).T
    # metres and radians do not compare: scaled to a unit diagonal, the matrix shows whether it can be inverted
    scale = np.sqrt(np.clip(np.diag(C), 0.0, None))
    if not scale.min() > 0.0:
        return
    with np.errstate(all="ignore"):
        scaled = C / scale / scale[:, None]
        if not np.isfinite(scaled).all() or np.linalg.cond(scaled) >= _WELL_CONDITIONED:
            return
        inverse = np.linalg.inv(scaled) / scale / scale[:, None]
    yield mav.MAVLink_arm_stiffness_message(stamp, [float(k) for k in inverse[_UPPER]], mav.ARM_MATRIX_STIFFNESS)


def payload_message(stamp: int, payload: PayloadReport) -> Message:
    """ARM_PAYLOAD.

    Args:
        stamp: Unix time, us.
        payload: the estimate.
    """
    return mav.MAVLink_arm_payload_message(
        stamp,
        payload.mass,
        payload.mass_sigma,
        list(payload.centre_of_mass_b),
        list(payload.centre_of_mass_sigma),
        int(payload.valid),
    )


def tendon_messages(
    stamp: int,
    tendons: Sequence[TendonState],
    goals: Sequence[float] | None,
    tensions: Sequence[TensionEstimate] = (),
) -> Iterator[Message]:
    """ARM_TENDONS, one for each four tendons.

    Args:
        stamp: Unix time, us.
        tendons: state of each.
        goals: commanded displacement of each, m.
        tensions: estimates that replace those which the loads alone give; none when empty.
    """
    estimates = tensions or [TensionEstimate(t.tension, t.tension_sigma) for t in tendons]
    for first in range(0, len(tendons), PER_MESSAGE):
        group = tendons[first : first + PER_MESSAGE]
        wanted = (math.nan,) * len(group) if goals is None else goals[first : first + PER_MESSAGE]
        yield mav.MAVLink_arm_tendons_message(
            stamp,
            _padded([t.pull for t in group], math.nan),
            _padded(wanted, math.nan),
            _padded([e.tension for e in estimates[first : first + PER_MESSAGE]], math.nan),
            _padded([e.sigma for e in estimates[first : first + PER_MESSAGE]], math.nan),
            _padded([_scaled(t.load, 1e3, -_INT16_MAX, _INT16_MAX) for t in group], _INT16_MAX),
            _padded([_scaled(t.temperature, 1e2, -_INT16_MAX, _INT16_MAX) for t in group], _INT16_MAX),
            _padded([_scaled(t.voltage, 1e3, 0, _UINT16_MAX) for t in group], _UINT16_MAX),
            _padded([t.error_bits & _UINT8_MAX for t in group], 0),
            first,
            len(group),
            sum(t.silent << i for i, t in enumerate(group)),
            sum(t.torque << i for i, t in enumerate(group)),
        )


def _padded(values: Iterable[Number], filler: Number) -> list[Number]:
    return list(itertools.islice(itertools.chain(values, itertools.repeat(filler)), PER_MESSAGE))


def _scaled(value: float, factor: float, lower: int, upper: int) -> int:
    """A number as the integer that goes over the wire; `upper` itself means that it is not known."""
    if not math.isfinite(value):
        return upper
    return round(min(max(value * factor, lower), upper - 1))
