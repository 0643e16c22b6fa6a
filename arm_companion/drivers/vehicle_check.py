"""Looks at the autopilot's settings after start and reboot, and says what is missing and how to mend it."""

import asyncio
import logging
import struct
from collections.abc import Callable, Sequence
from typing import Final

from arm_companion.config.schema import MavlinkConfig, VehicleConfig
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.flight_stack import AUTOPILOT_COMPONENT
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.vehicle_expectations import Finding, judge, judge_rates, names
from arm_companion.mission.facts import Notice, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

ANSWER_WITHIN_S: Final = 0.5
TRIES: Final = 3
_SETTLE_S: Final = 2.0
"""After the autopilot was heard first: it has heard us then, too, and a route to us stands."""

_LOOK_EVERY_S: Final = 1.0
_WHOLE: Final = frozenset(
    {
        mav.MAV_PARAM_TYPE_UINT8,
        mav.MAV_PARAM_TYPE_INT8,
        mav.MAV_PARAM_TYPE_UINT16,
        mav.MAV_PARAM_TYPE_INT16,
        mav.MAV_PARAM_TYPE_UINT32,
        mav.MAV_PARAM_TYPE_INT32,
    }
)


class ParameterReader:
    """Reads single parameters of the autopilot.

    Args:
        link: connection to it.
        autopilot: who it is.
        bytewise: whether whole numbers come as their bytes (PX4) or as a float's value (ArduPilot).
    """

    def __init__(self, link: MavlinkLink, autopilot: Autopilot, *, bytewise: bool) -> None:
        self._link = link
        self._autopilot = autopilot
        self._bytewise = bytewise
        self._waiting: dict[str, asyncio.Future[float]] = {}
        link.subscribe(self._on_value, (mav.MAVLINK_MSG_ID_PARAM_VALUE,))

    async def read(self, wanted: Sequence[str]) -> dict[str, float]:
        """The parameters that the autopilot has, one after the other; those that it does not answer are missing."""
        found = {}
        for name in wanted:
            value = await self._read_one(name)
            if value is not None:
                found[name] = value
        return found

    async def _read_one(self, name: str) -> float | None:
        self._waiting[name] = future = asyncio.get_running_loop().create_future()
        try:
            for _ in range(TRIES):
                self._link.send(
                    mav.MAVLink_param_request_read_message(
                        self._autopilot.system_id, AUTOPILOT_COMPONENT, name.encode(), -1
                    )
                )
                try:
                    async with asyncio.timeout(ANSWER_WITHIN_S):
                        return await asyncio.shield(future)
                except TimeoutError:
                    continue
        finally:
            del self._waiting[name]
        return None

    def _on_value(self, message: Message, _: MavlinkLink) -> None:
        if (message.get_srcSystem(), message.get_srcComponent()) != (self._autopilot.system_id, AUTOPILOT_COMPONENT):
            return
        future = self._waiting.get(message.param_id)
        if future is not None and not future.done():
            value = message.param_value
            if self._bytewise and message.param_type in _WHOLE:
                value = float(struct.unpack("<i", struct.pack("<f", value))[0])
            future.set_result(value)


class VehicleCheck:
    """The check.

    Args:
        link: connection to the autopilot.
        autopilot: who it is, how often it booted, and which streams stay slow.
        vehicle: flight stack.
        mavlink: whether to look at all, and the port's number.
        tell: says a finding to people.
    """

    def __init__(
        self,
        link: MavlinkLink,
        autopilot: Autopilot,
        vehicle: VehicleConfig,
        mavlink: MavlinkConfig,
        tell: Callable[[Notice], None],
    ) -> None:
        self.findings: list[Finding] = []
        """What was found last, mended or not."""
        self._link = link
        self._autopilot = autopilot
        self._flavour = vehicle.autopilot
        self._config = mavlink
        self._tell = tell
        self._reader = ParameterReader(link, autopilot, bytewise=vehicle.autopilot == "px4")
        self._told: set[str] = set()

    async def run(self) -> None:
        """Look once after each boot of the autopilot, and at its streams all the time, until cancelled."""
        boots = -1
        while self._config.check_vehicle:
            await asyncio.sleep(_LOOK_EVERY_S)
            if not self._autopilot.heard:
                continue
            if boots != self._autopilot.counters.reboots:
                boots = self._autopilot.counters.reboots
                self._told.clear()
                await asyncio.sleep(_SETTLE_S)
                await self.look()
            self._say(judge_rates(self._autopilot.slow_streams))
            self._say(self._judge_line())

    async def look(self) -> list[Finding]:
        """Read and judge the parameters now; what is found is told once."""
        instance = self._config.vehicle_instance
        wanted = names(self._flavour, instance)
        values = await self._reader.read(wanted)
        self.findings = judge(self._flavour, instance, values)
        if not values:
            mend = "check that it takes commands from this computer's system and component id"
            self.findings = [Finding(Severity.WARNING, "the autopilot answers no parameter request", mend, "")]
        if missing := [name for name in wanted if name not in values]:
            log.info("vehicle check: the autopilot has no %s", ", ".join(missing))
        if not self.findings:
            log.info("vehicle check: %s", ", ".join(f"{name} = {value:g}" for name, value in values.items()))
        self._say(self.findings)
        return self.findings

    def _judge_line(self) -> list[Finding]:
        """Whether the line is too slow for the set-points."""
        if not self._link.counters.late:
            return []
        what = f"set-points are left out, the link to the autopilot takes only {self._link.bandwidth:.0f} bytes/s"
        mend = "make it faster or lower rates.cycle_hz"
        return [Finding(Severity.WARNING, what, mend, "bandwidth")]

    def _say(self, findings: Sequence[Finding]) -> None:
        for finding in findings:
            if finding.about in self._told:
                continue
            self._told.add(finding.about)
            log.warning("vehicle check: %s", finding.text)
            self._tell(Notice(finding.severity, f"vehicle: {finding.text}"))
