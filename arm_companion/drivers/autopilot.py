"""The autopilot on its link: the vehicle's state as it arrives, and set-points on their way out."""

import asyncio
import logging
import math
from dataclasses import dataclass
from typing import Final

from arm_companion.config.schema import VehicleConfig
from arm_companion.drivers.flight_stack import (
    AUTOPILOT_COMPONENT,
    AutopilotFinder,
    control_of,
    fits,
    mode_name,
)
from arm_companion.drivers.mavlink_link import MavlinkLink, Priority
from arm_companion.drivers.path_feedforward import PathFeedforward
from arm_companion.drivers.timesync import Timesync
from arm_companion.errors import ProtocolError
from arm_companion.mission.facts import Control, Quaternion, Setpoint, Vec3, VehicleState
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

log = logging.getLogger(__name__)

HEARTBEAT: Final = mav.MAVLINK_MSG_ID_HEARTBEAT
ATTITUDE: Final = mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
POSITION: Final = mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED
THRUST: Final = mav.MAVLINK_MSG_ID_ATTITUDE_TARGET
LANDED: Final = mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
THROTTLE: Final = mav.MAVLINK_MSG_ID_VFR_HUD
ACK: Final = mav.MAVLINK_MSG_ID_COMMAND_ACK

LANDED_RATE_HZ: Final = 5.0
THROTTLE_RATE_HZ: Final = 10.0
THRUST_RATE_HZ: Final = 50.0
CHECK_PERIOD_S: Final = 1.0
"""How often the arriving rates are held against the asked ones."""

_ENOUGH: Final = 0.5
"""Share of the asked rate that counts as flowing: PX4 gives 124 Hz where 200 are asked."""

_GIVE_UP: Final = 5
"""Checks in a row after which a stream counts as one that the autopilot does not give."""

_ESTIMATOR_S: Final = 60.0
"""So long an autopilot may take until its estimator has a position to send; ArduPilot takes some 42 s."""

_SURE_S: Final = 0.02
"""A state's own time stamp is believed when the clocks are known to agree this well."""

_SAME_CLOCK_S: Final = 5.0
"""A stamp that is farther from its arrival was made by another clock than TIMESYNC's."""

_REBOOT_BACK_MS: Final = 1000
"""A boot time that goes back by more than this belongs to a new boot, not to a late frame."""

_TYPE_MASK: Final = mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
"""Position, velocity, acceleration and yaw all count: both flight stacks misread partial set-points."""


@dataclass(slots=True)
class AutopilotCounters:
    """What the driver has seen since its start."""

    invalid: int = 0  # state messages with values that no vehicle can have
    reboots: int = 0
    interval_requests: int = 0
    setpoints: int = 0
    setpoints_unsent: int = 0  # no autopilot known yet


class Autopilot:
    """State of the vehicle, and where it is asked to go.

    Args:
        link: connection to the autopilot.
        vehicle: flight stack, rates and time-outs.
        timesync: how its clock stands against ours; without it states count from their arrival.
    """

    def __init__(self, link: MavlinkLink, vehicle: VehicleConfig, timesync: Timesync | None = None) -> None:
        self.counters = AutopilotCounters()
        self._link = link
        self._config = vehicle
        self._timesync = timesync
        self._finder = AutopilotFinder(vehicle)
        self._rates = {
            ATTITUDE: vehicle.state_rate_hz,
            POSITION: vehicle.state_rate_hz,
            THRUST: THRUST_RATE_HZ,
            LANDED: LANDED_RATE_HZ,
            THROTTLE: THROTTLE_RATE_HZ,
        }
        self._arrived = dict.fromkeys(self._rates, 0)
        self._slow = dict.fromkeys(self._rates, (False, 0))  # nothing came, and checks in a row that it was so little
        self.slow_streams: dict[str, tuple[float, float]] = {}
        """Messages that stay too slow however often they are asked for: rate asked for and rate measured, Hz."""
        self._refused: set[int] = set()
        self._boot_ms: dict[int, int] = {}
        self._check_now = asyncio.Event()
        self._mismatch_told = False
        self._path = PathFeedforward() if vehicle.autopilot == "ardupilot" else None
        self._reset()
        link.subscribe(self._on_message, (HEARTBEAT, ATTITUDE, POSITION, THRUST, LANDED, THROTTLE, ACK))

    def _reset(self) -> None:
        self._heartbeat: Message | None = None
        self._heartbeat_at = self._attitude_at = self._position_at = float("-inf")
        self._attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._rate: Vec3 = (0.0, 0.0, 0.0)
        self._position: Vec3 = (0.0, 0.0, 0.0)
        self._velocity: Vec3 = (0.0, 0.0, 0.0)
        self._thrust = math.nan
        self._thrust_at = float("-inf")
        self._landed = True
        self._throttle, self._throttle_at = 0.0, float("-inf")

    @property
    def system_id(self) -> int:
        """The autopilot's system id, 0 until it has been heard."""
        return self._finder.system_id

    @property
    def heard(self) -> bool:
        """Whether the autopilot has been heard at all."""
        return self._heartbeat is not None

    def state(self, now: float) -> VehicleState:
        """Newest state of the vehicle.

        Args:
            now: loop time, for the ages.
        """
        beat = self._heartbeat
        flavour = self._config.autopilot
        return VehicleState(
            position_w=self._position,
            velocity_w=self._velocity,
            attitude_wb=self._attitude,
            rate_b=self._rate,
            armed=beat is not None and bool(beat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED),
            landed=self._landed,
            control=Control.UNKNOWN if beat is None else control_of(beat, flavour),
            mode="" if beat is None else mode_name(beat, flavour),
            heartbeat_age_s=now - self._heartbeat_at,
            position_age_s=now - self._position_at,
            attitude_age_s=now - self._attitude_at,
            throttle=self._throttle,
            throttle_age_s=now - self._throttle_at,
            thrust=self._thrust if now - self._thrust_at <= self._config.state_timeout_s else math.nan,
            clock_error_s=float("inf") if self._timesync is None else self._timesync.error_s,
        )

    def send(self, setpoint: Setpoint, now: float) -> None:
        """Send a set-point at once. Before an autopilot has been heard it is counted and dropped.

        Raises:
            ProtocolError: a value is not finite; nothing is sent.
        """
        values = (*setpoint.position_w, *setpoint.velocity_w, *setpoint.acceleration_w, setpoint.yaw)
        if not all(map(math.isfinite, values)):
            raise ProtocolError(f"set-point is not finite: {setpoint}")
        if self._heartbeat is None:
            self.counters.setpoints_unsent += 1
            return
        if self._path is not None:
            if not self._flies_our_path(self._heartbeat):
                self._path.reset()
            setpoint = self._path.shaped(setpoint, now)
        stamp = None if self._timesync is None else self._timesync.autopilot_time(now)
        message = mav.MAVLink_set_position_target_local_ned_message(
            int((now if stamp is None else max(stamp, 0.0)) * 1e3) & 0xFFFFFFFF,
            self.system_id,
            AUTOPILOT_COMPONENT,
            mav.MAV_FRAME_LOCAL_NED,
            _TYPE_MASK,
            *setpoint.position_w,
            *setpoint.velocity_w,
            *setpoint.acceleration_w,
            setpoint.yaw,
            0.0,
        )
        self._link.send(message, Priority.NOW)
        self.counters.setpoints += 1

    async def run(self) -> None:
        """Ask for the state messages, and ask again for whichever does not flow, until cancelled."""
        loop = asyncio.get_running_loop()
        since = loop.time()
        while True:
            try:
                async with asyncio.timeout(CHECK_PERIOD_S):
                    await self._check_now.wait()
            except TimeoutError:
                pass
            if self._heartbeat is None:
                since = loop.time()
                continue
            fresh = self._check_now.is_set()
            self._check_now.clear()
            elapsed = loop.time() - since
            for id_, rate in self._rates.items():
                enough = self._arrived[id_] >= _ENOUGH * rate * elapsed
                if fresh or not enough:
                    self._request(id_, rate)
                self._judge(id_, rate, self._arrived[id_] / max(elapsed, 1e-3), slow=not (fresh or enough))
                self._arrived[id_] = 0
            since = loop.time()

    def _judge(self, id_: int, asked: float, got: float, *, slow: bool) -> None:
        """Count checks in a row of one kind: a stream that has just begun is not yet slow for having been silent."""
        silent = got == 0.0
        was_silent, checks = self._slow[id_]
        self._slow[id_] = (silent, checks + 1 if silent is was_silent else 1) if slow else (silent, 0)
        name = mav.mavlink_map[id_].msgname
        self.slow_streams.pop(name, None)
        patience = _ESTIMATOR_S / CHECK_PERIOD_S if id_ == POSITION and silent else _GIVE_UP
        if self._slow[id_][1] >= patience:
            self.slow_streams[name] = (asked, got)

    def _request(self, id_: int, rate_hz: float) -> None:
        message = mav.MAVLink_command_long_message(
            self.system_id,
            AUTOPILOT_COMPONENT,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL,
            0,
            float(id_),
            round(1e6 / rate_hz),
            0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
        self.counters.interval_requests += 1
        self._link.send(message, Priority.NORMAL)

    def _on_message(self, message: Message, _: MavlinkLink) -> None:
        now = asyncio.get_running_loop().time()
        id_ = message.get_msgId()
        if id_ == HEARTBEAT:
            self._on_heartbeat(message, now)
            return
        if self._heartbeat is None or (message.get_srcSystem(), message.get_srcComponent()) != (
            self.system_id,
            AUTOPILOT_COMPONENT,
        ):
            return
        match id_:
            case mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
                self._on_attitude(message, now)
            case mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
                self._on_position(message, now)
            case mav.MAVLINK_MSG_ID_ATTITUDE_TARGET:
                self._on_thrust(message, now)
            case mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
                self._arrived[LANDED] += 1
                if message.landed_state != mav.MAV_LANDED_STATE_UNDEFINED:
                    self._landed = message.landed_state == mav.MAV_LANDED_STATE_ON_GROUND
            case mav.MAVLINK_MSG_ID_VFR_HUD:
                self._arrived[THROTTLE] += 1
                self._throttle, self._throttle_at = message.throttle / 100.0, now
            case mav.MAVLINK_MSG_ID_COMMAND_ACK:
                self._on_ack(message)

    def _on_heartbeat(self, beat: Message, now: float) -> None:
        before = self.system_id
        stranger = self._finder.stranger
        if not self._finder.heard(beat, now):
            if stranger == 0 and self._finder.stranger:
                log.warning(
                    "the autopilot, system %d, is silent and was armed: system %d does not take its place",
                    before,
                    self._finder.stranger,
                )
            return
        if before not in (0, self.system_id):
            log.warning("the autopilot is system %d now, it was %d", self.system_id, before)
            self._reset()
        if not self._config.system_id:
            self._link.system_id = self.system_id  # we are a part of the vehicle that we fly on
        came_back = now - self._heartbeat_at > self._config.heartbeat_timeout_s
        self._heartbeat, self._heartbeat_at = beat, now
        if self._path is not None and not self._flies_our_path(beat):
            self._path.reset()
        if came_back:
            self._check_now.set()
        if not self._mismatch_told and not fits(beat, self._config.autopilot):
            self._mismatch_told = True
            log.error(
                "the autopilot is of type %d, not %s: its modes are not read and the arm will not fly it",
                beat.autopilot,
                self._config.autopilot,
            )

    def _flies_our_path(self, beat: Message) -> bool:
        """Whether the autopilot's integrators still hold what the path handed over: no entry into GUIDED, no landing.

        Asked at every heartbeat too, because set-points stop in the cycle in which the pilot takes over.
        """
        armed = bool(beat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
        return armed and control_of(beat, self._config.autopilot) is Control.EXTERNAL

    def _on_attitude(self, m: Message, now: float) -> None:
        q = (m.q1, m.q2, m.q3, m.q4)
        rate = (m.rollspeed, m.pitchspeed, m.yawspeed)
        norm = math.hypot(*q)
        if not (0.9 < norm < 1.1 and all(map(math.isfinite, rate))):
            self.counters.invalid += 1
            return
        if self._arrival(ATTITUDE, m.time_boot_ms):
            self._attitude = (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)
            self._rate = rate
            self._attitude_at = self._measured_at(m.time_boot_ms, now)

    def _on_position(self, m: Message, now: float) -> None:
        position, velocity = (m.x, m.y, m.z), (m.vx, m.vy, m.vz)
        if not all(map(math.isfinite, (*position, *velocity))):
            self.counters.invalid += 1
            return
        if self._arrival(POSITION, m.time_boot_ms):
            self._position, self._velocity = position, velocity
            self._position_at = self._measured_at(m.time_boot_ms, now)

    def _on_thrust(self, m: Message, now: float) -> None:
        if not 0.0 <= m.thrust <= 1.0:
            self.counters.invalid += 1
            return
        if self._arrival(THRUST, m.time_boot_ms):
            self._thrust, self._thrust_at = m.thrust, now

    def _measured_at(self, boot_ms: int, now: float) -> float:
        """Loop time of a state: by its own stamp where the clocks are tied together, else its arrival."""
        if self._timesync is None or self._timesync.error_s > _SURE_S:
            return now
        at = self._timesync.loop_time(boot_ms * 1e-3)
        return now if at is None or abs(now - at) > _SAME_CLOCK_S else min(now, at)

    def _arrival(self, id_: int, boot_ms: int) -> bool:
        """Count a state message and see whether the autopilot has booted anew; False for a late one, or a repeated."""
        last = self._boot_ms.get(id_, -1)
        if boot_ms < last - _REBOOT_BACK_MS:
            log.warning("the autopilot has rebooted; asking for its state again")
            self.counters.reboots += 1
            self._boot_ms.clear()
            self._check_now.set()
            if self._timesync is not None:
                self._timesync.forget()
        elif boot_ms <= last:
            return False
        self._boot_ms[id_] = boot_ms
        self._arrived[id_] += 1
        return True

    def _on_ack(self, ack: Message) -> None:
        ours = ack.target_system in (0, self._link.system_id) and ack.target_component in (
            0,
            self._link.component_id,
        )
        if not ours or ack.command != mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            return
        if ack.result not in (mav.MAV_RESULT_ACCEPTED, *self._refused):
            self._refused.add(ack.result)
            log.warning("the autopilot refuses a message interval (result %d)", ack.result)
