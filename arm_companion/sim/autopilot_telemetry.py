"""The stand-in's outgoing state: every message that it can send."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from arm_companion.protocol.dialect import mav
from arm_companion.sim.autopilot_flavours import Flavour, Mode
from arm_companion.sim.autopilot_modes import FlightModes
from arm_companion.sim.flight_control import Estimate

HOME_LATITUDE_DEG, HOME_LONGITUDE_DEG, HOME_ALTITUDE_M = 47.397742, 8.545594, 488.0
_M_PER_DEG = 111_319.49
_UNKNOWN_U16 = 65535
_CELLS = 4
_FULL_V = _CELLS * 4.18 - 0.02 * 14.5
_THRUST_OF_VOLTAGE = 1.6


@dataclass(slots=True)
class Battery:
    """A four-cell battery that empties with the thrust, and sags under it."""

    capacity_mah: float = 5000.0
    used_mah: float = 0.0
    current_a: float = 0.5

    def draw(self, thrust_share: float, dt: float) -> None:
        """Rotor power grows with thrust to the power 3/2; hover takes 14 A."""
        self.current_a = 0.5 + 14.0 * max(thrust_share, 0.0) ** 1.5
        self.used_mah = min(self.used_mah + self.current_a * dt / 3.6, self.capacity_mah)

    @property
    def remaining(self) -> float:
        """Share left."""
        return 1.0 - self.used_mah / self.capacity_mah

    @property
    def voltage(self) -> float:
        """V at the terminals."""
        return _CELLS * (3.5 + 0.68 * self.remaining) - 0.02 * self.current_a

    @property
    def thrust_share(self) -> float:
        """Thrust of rotors on this voltage over that on a full battery at hover: rotor speed follows V^0.8."""
        return math.pow(self.voltage / _FULL_V, _THRUST_OF_VOLTAGE)


Builder = Callable[[], Any]
"""Makes a message of the present state, or None while that is not known."""


class Telemetry:
    """Builds messages from the autopilot's present state.

    Attributes:
        now_s: seconds since boot, the stamp of what is built.
    """

    def __init__(self, flavour: Flavour, modes: FlightModes, battery: Battery) -> None:
        self._flavour = flavour
        self._modes = modes
        self._battery = battery
        self.now_s = 0.0
        self._build: dict[int, Builder] = {
            mav.MAVLINK_MSG_ID_HEARTBEAT: self.heartbeat,
            mav.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_sys_state,
            mav.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: self._attitude_target,
            mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position_ned,
            mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position_int,
            mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: self._position_target,
            mav.MAVLINK_MSG_ID_HIGHRES_IMU: self._highres_imu,
            mav.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw_int,
            mav.MAVLINK_MSG_ID_VFR_HUD: self._vfr_hud,
            mav.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery_status,
            mav.MAVLINK_MSG_ID_HOME_POSITION: self._home_position,
            mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._autopilot_version,
            mav.MAVLINK_MSG_ID_TIMESYNC: self._timesync,
        }
        if flavour.is_px4:
            self._build[mav.MAVLINK_MSG_ID_ODOMETRY] = self._odometry

    def knows(self, message: int) -> bool:
        """Whether the message exists on this autopilot."""
        return message in self._build

    def build(self, message: int) -> Any | None:
        """The message as it is now; None while what it reports is not known."""
        return self._build[message]()

    @property
    def _estimate(self) -> Estimate:
        return self._modes.estimate

    @property
    def _boot_ms(self) -> int:
        return int(self.now_s * 1e3) & 0xFFFFFFFF

    @property
    def _boot_us(self) -> int:
        return int(self.now_s * 1e6)

    def heartbeat(self) -> Any:
        """HEARTBEAT with the stack's own mode number."""
        modes = self._modes
        flags = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
        if modes.mode in (Mode.MANUAL, Mode.ALTITUDE, Mode.POSITION):
            flags |= mav.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        else:
            flags |= mav.MAV_MODE_FLAG_GUIDED_ENABLED | mav.MAV_MODE_FLAG_AUTO_ENABLED
        status = mav.MAV_STATE_STANDBY
        if modes.armed:
            flags |= mav.MAV_MODE_FLAG_SAFETY_ARMED
            status = mav.MAV_STATE_CRITICAL if modes.failsafe else mav.MAV_STATE_ACTIVE
        if modes.emergency:  # PX4's blind descent
            status = mav.MAV_STATE_EMERGENCY if self._flavour.is_px4 else mav.MAV_STATE_CRITICAL
        number = self._flavour.modes[modes.mode]
        kind, version = mav.MAV_TYPE_QUADROTOR, 3
        return mav.MAVLink_heartbeat_message(kind, self._flavour.autopilot, flags, number, status, version)

    def _sys_status(self) -> Any:
        present = (
            mav.MAV_SYS_STATUS_SENSOR_3D_GYRO
            | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
            | mav.MAV_SYS_STATUS_SENSOR_3D_MAG
            | mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
            | mav.MAV_SYS_STATUS_SENSOR_GPS
            | mav.MAV_SYS_STATUS_AHRS
            | mav.MAV_SYS_STATUS_SENSOR_BATTERY
            | mav.MAV_SYS_STATUS_PREARM_CHECK
        )
        healthy = present
        if not self._modes.ready:
            healthy &= ~(mav.MAV_SYS_STATUS_AHRS | mav.MAV_SYS_STATUS_PREARM_CHECK)
        return mav.MAVLink_sys_status_message(
            onboard_control_sensors_present=present,
            onboard_control_sensors_enabled=present,
            onboard_control_sensors_health=healthy,
            load=350,
            voltage_battery=round(self._battery.voltage * 1e3),
            current_battery=round(self._battery.current_a * 100),
            battery_remaining=round(self._battery.remaining * 100),
            drop_rate_comm=0,
            errors_comm=0,
            errors_count1=0,
            errors_count2=0,
            errors_count3=0,
            errors_count4=0,
        )

    def _extended_sys_state(self) -> Any:
        return mav.MAVLink_extended_sys_state_message(mav.MAV_VTOL_STATE_UNDEFINED, self._modes.landed_state)

    def _attitude(self) -> Any:
        return mav.MAVLink_attitude_message(self._boot_ms, *self._estimate.euler, *self._estimate.rate_b)

    def _attitude_quaternion(self) -> Any:
        e = self._estimate
        return mav.MAVLink_attitude_quaternion_message(self._boot_ms, *e.attitude_wb, *e.rate_b)

    def _attitude_target(self) -> Any:
        """The thrust asked for; attitude and rates are masked, since nobody needs them."""
        mask = mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE | (
            mav.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
            | mav.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
            | mav.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
        )
        thrust = min(self._flavour.hover_thrust * self._modes.thrust_share, 1.0)
        return mav.MAVLink_attitude_target_message(self._boot_ms, mask, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, thrust)

    def _local_position_ned(self) -> Any | None:
        if not self._modes.ready:
            return None
        e = self._estimate
        return mav.MAVLink_local_position_ned_message(self._boot_ms, *e.position_w, *e.velocity_w)

    def _odometry(self) -> Any | None:
        if not self._modes.ready:
            return None
        e = self._estimate
        unknown = (math.nan,) + (0.0,) * 20
        return mav.MAVLink_odometry_message(
            self._boot_us,
            mav.MAV_FRAME_LOCAL_NED,
            mav.MAV_FRAME_BODY_FRD,
            *e.position_w,
            e.attitude_wb,
            *e.velocity_b,
            *e.rate_b,
            unknown,
            unknown,
            0,
            mav.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        )

    def _global_position_int(self) -> Any | None:
        if not self._modes.ready:
            return None
        north, east, down = self._estimate.position_w
        latitude, longitude = _degrees_1e7(north, east)
        return mav.MAVLink_global_position_int_message(
            self._boot_ms,
            latitude,
            longitude,
            round((HOME_ALTITUDE_M - down) * 1e3),
            round((self._modes.home[2] - down) * 1e3),
            *(round(v * 100) for v in self._estimate.velocity_w),
            round(math.degrees(self._estimate.yaw) * 100) % 36_000,
        )

    def _position_target(self) -> Any | None:
        """The set-point that is flown; what is not commanded is NaN and masked."""
        setpoint = self._modes.flown
        if setpoint is None:
            return None
        parts = (*setpoint.position_w, *setpoint.velocity_w, *setpoint.acceleration_w)
        mask = sum(1 << bit for bit, part in enumerate(parts) if part is None)
        values = [math.nan if part is None else part for part in parts]
        yaw = setpoint.yaw
        if yaw is None:
            mask |= mav.POSITION_TARGET_TYPEMASK_YAW_IGNORE
        return mav.MAVLink_position_target_local_ned_message(
            self._boot_ms,
            mav.MAV_FRAME_LOCAL_NED,
            mask,
            *values,
            math.nan if yaw is None else yaw,
            setpoint.yaw_rate,
        )

    def _highres_imu(self) -> Any:
        e = self._estimate
        unknown = math.nan
        fields = 0b111111  # accelerometer and gyro
        return mav.MAVLink_highres_imu_message(self._boot_us, *e.specific_force_b, *e.rate_b, *([unknown] * 7), fields)

    def _gps_raw_int(self) -> Any:
        north, east, down = self._estimate.position_w
        speed = math.hypot(*self._estimate.velocity_w[:2])
        return mav.MAVLink_gps_raw_int_message(
            self._boot_us,
            mav.GPS_FIX_TYPE_RTK_FIXED if self._modes.ready else mav.GPS_FIX_TYPE_NO_FIX,
            *_degrees_1e7(north, east),
            round((HOME_ALTITUDE_M - down) * 1e3),
            60,
            90,
            round(speed * 100),
            _UNKNOWN_U16,
            18,
        )

    def _vfr_hud(self) -> Any:
        e = self._estimate
        speed = math.hypot(e.velocity_w[0], e.velocity_w[1])
        heading = round(math.degrees(e.yaw)) % 360
        throttle = round(50 * self._modes.thrust_share)
        altitude = HOME_ALTITUDE_M - e.position_w[2]
        return mav.MAVLink_vfr_hud_message(speed, speed, heading, throttle, altitude, -e.velocity_w[2])

    def _battery_status(self) -> Any:
        battery = self._battery
        cells = [round(battery.voltage / _CELLS * 1e3)] * _CELLS + [_UNKNOWN_U16] * (10 - _CELLS)
        return mav.MAVLink_battery_status_message(
            0,
            mav.MAV_BATTERY_FUNCTION_ALL,
            mav.MAV_BATTERY_TYPE_LIPO,
            32767,
            cells,
            round(battery.current_a * 100),
            round(battery.used_mah),
            -1,
            round(battery.remaining * 100),
        )

    def _home_position(self) -> Any | None:
        if not self._modes.ready:
            return None
        x, y, z = self._modes.home
        place = (*_degrees_1e7(x, y), round((HOME_ALTITUDE_M - z) * 1e3))
        upright = (1.0, 0.0, 0.0, 0.0)
        return mav.MAVLink_home_position_message(*place, x, y, z, upright, 0.0, 0.0, 0.0, self._boot_us)

    def _autopilot_version(self) -> Any:
        capabilities = (
            mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | mav.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
            | mav.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        )
        capabilities |= (
            mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
            if self._flavour.bytewise_parameters
            else mav.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        )
        version = (1 << 24) | (17 << 16) if self._flavour.is_px4 else (4 << 24) | (7 << 16)
        none = (0,) * 8
        return mav.MAVLink_autopilot_version_message(capabilities, version, 0, 0, 0, none, none, none, 0, 0, 1)

    def _timesync(self) -> Any:
        return mav.MAVLink_timesync_message(0, int(self.now_s * 1e9))


def _degrees_1e7(north_m: float, east_m: float) -> tuple[int, int]:
    """Latitude and longitude of a point near home, 1e-7 deg."""
    latitude = HOME_LATITUDE_DEG + north_m / _M_PER_DEG
    longitude = HOME_LONGITUDE_DEG + east_m / (_M_PER_DEG * math.cos(math.radians(HOME_LATITUDE_DEG)))
    return round(latitude * 1e7), round(longitude * 1e7)
