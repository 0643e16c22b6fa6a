"""What differs between PX4 and ArduPilot copter on the wire, as data. Figures measured on both are noted."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field

from arm_companion.protocol.dialect import mav

OFFBOARD_LOSS_TIMEOUT = "COM_OF_LOSS_T"
OFFBOARD_LOSS_ACTION = "COM_OBL_RC_ACT"
TAKEOFF_ALTITUDE = "MIS_TAKEOFF_ALT"
DISARM_LANDED = "COM_DISARM_LAND"
DISARM_PREFLIGHT = "COM_DISARM_PRFLT"
FORWARD = "MAV_1_FORWARD"
GUIDED_TIMEOUT = "GUID_TIMEOUT"
DISARM_DELAY = "DISARM_DELAY"
LINK_OPTIONS = "MAV2_OPTIONS"


class Mode(enum.Enum):
    """Flight modes that the stand-in knows, under the names of PX4."""

    MANUAL = "MANUAL"
    ALTITUDE = "ALTCTL"
    POSITION = "POSCTL"
    HOLD = "LOITER"
    TAKEOFF = "TAKEOFF"
    LAND = "LAND"
    RETURN = "RTL"
    EXTERNAL = "OFFBOARD"


def px4_mode(main: int, sub: int = 0) -> int:
    """PX4's custom_mode: main mode in the third byte, sub mode in the fourth."""
    return main << 16 | sub << 24


@dataclass(frozen=True)
class Flavour:
    """One flight stack's habits.

    Attributes:
        name: as in [vehicle] autopilot.
        autopilot: MAV_AUTOPILOT.
        modes: custom_mode of each mode; of two modes with one number the first is meant when it is asked for.
        names: the stack's own name of each mode, for `take_over`.
        boot_mode: mode after power-up.
        hover_thrust: share of full thrust at which the vehicle is believed to hover.
        ready_s: s from boot to a ready estimator and arming.
        refused: MAV_RESULT of a refused arming or mode.
        mode_acks_first: DO_SET_MODE is acknowledged as accepted before it is tried, and then again.
        ack_delay_s: least and greatest time to an ack.
        loop_hz: rate of the main loop that sends streams.
        period_share: real over asked period of a stream.
        least_period_s: fastest stream.
        refuse_faster: faster streams are denied instead of slowed.
        unknown_stream: MAV_RESULT when an interval is asked for a message that there is not.
        companion_hz: default streams of the companion port.
        ground_hz: default streams of the ground port.
        not_forwarded: public message ids that it does not pass between its ports.
        burst: frames that a port's forward buffer holds, and s that each takes to leave; None forwards all.
        forward_delay_s: s from port to port.
        parameters: names and defaults; int and float are the two types.
        bytewise_parameters: whole numbers travel as their bytes (PX4), not as a float's value (ArduPilot).
    """

    name: str
    autopilot: int
    modes: Mapping[Mode, int]
    names: Mapping[str, Mode]
    boot_mode: Mode
    hover_thrust: float
    ready_s: float
    refused: int
    mode_acks_first: bool
    ack_delay_s: tuple[float, float]
    loop_hz: float
    period_share: float
    least_period_s: float
    refuse_faster: bool
    unknown_stream: int
    not_forwarded: frozenset[int]
    burst: tuple[int, float] | None
    forward_delay_s: float
    parameters: Mapping[str, float]
    bytewise_parameters: bool
    companion_hz: Mapping[int, float] = field(default_factory=dict)
    ground_hz: Mapping[int, float] = field(default_factory=dict)

    @property
    def is_px4(self) -> bool:
        """Whether this is PX4; what is behaviour rather than a figure asks here."""
        return self.autopilot == int(mav.MAV_AUTOPILOT_PX4)


_PX4_AUTO = 4
_PX4_MODES = {
    Mode.MANUAL: px4_mode(1),
    Mode.ALTITUDE: px4_mode(2),
    Mode.POSITION: px4_mode(3),
    Mode.TAKEOFF: px4_mode(_PX4_AUTO, 2),
    Mode.HOLD: px4_mode(_PX4_AUTO, 3),
    Mode.RETURN: px4_mode(_PX4_AUTO, 5),
    Mode.LAND: px4_mode(_PX4_AUTO, 6),
    Mode.EXTERNAL: px4_mode(6),
}

PX4 = Flavour(
    name="px4",
    autopilot=mav.MAV_AUTOPILOT_PX4,
    modes=_PX4_MODES,
    names={mode.value: mode for mode in Mode} | {"HOLD": Mode.HOLD},
    boot_mode=Mode.HOLD,
    hover_thrust=0.5,  # MPC_THR_HOVER
    ready_s=8.0,
    refused=mav.MAV_RESULT_TEMPORARILY_REJECTED,
    mode_acks_first=True,
    ack_delay_s=(0.003, 0.015),
    loop_hz=250.0,
    period_share=1.007,  # 100 Hz asked gives 99.3
    least_period_s=1.0 / 124.0,  # 200 Hz asked gives 124
    refuse_faster=False,
    unknown_stream=mav.MAV_RESULT_FAILED,
    not_forwarded=frozenset(),
    burst=(5, 0.0037),  # of 100 frames: 5 pass back to back, 59 at 2 ms, all at 5 ms
    forward_delay_s=0.0005,
    parameters={
        OFFBOARD_LOSS_TIMEOUT: 1.0,
        OFFBOARD_LOSS_ACTION: 5,
        DISARM_LANDED: 2.0,
        DISARM_PREFLIGHT: 10.0,
        TAKEOFF_ALTITUDE: 2.5,
        FORWARD: 1,
        "MAV_SYS_ID": 1,
        "MAV_COMP_ID": 1,
        "MAV_TYPE": mav.MAV_TYPE_QUADROTOR,
        "SYS_AUTOSTART": 4001,
    },
    bytewise_parameters=True,
    companion_hz={
        mav.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
        mav.MAVLINK_MSG_ID_ATTITUDE: 50.0,
        mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
        mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: 50.0,
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
        mav.MAVLINK_MSG_ID_ODOMETRY: 30.0,
        mav.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
        mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
        mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 10.0,
        mav.MAVLINK_MSG_ID_TIMESYNC: 10.0,
        mav.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
        mav.MAVLINK_MSG_ID_SYS_STATUS: 5.0,
        mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
        mav.MAVLINK_MSG_ID_VFR_HUD: 10.0,
        mav.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
        mav.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    },
    ground_hz={
        mav.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
        mav.MAVLINK_MSG_ID_ATTITUDE: 15.0,
        mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 10.0,
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 5.0,
        mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
        mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 1.5,
        mav.MAVLINK_MSG_ID_GPS_RAW_INT: 1.0,
        mav.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
        mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
        mav.MAVLINK_MSG_ID_VFR_HUD: 4.0,
        mav.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
        mav.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    },
)

_ARDUPILOT_MODES = {
    Mode.MANUAL: 0,  # STABILIZE
    Mode.ALTITUDE: 2,  # ALT_HOLD
    Mode.EXTERNAL: 4,  # GUIDED
    Mode.TAKEOFF: 4,  # a guided take-off is a part of GUIDED
    Mode.POSITION: 5,  # LOITER
    Mode.RETURN: 6,  # RTL
    Mode.LAND: 9,  # LAND
    Mode.HOLD: 17,  # BRAKE
}

ARDUPILOT = Flavour(
    name="ardupilot",
    autopilot=mav.MAV_AUTOPILOT_ARDUPILOTMEGA,
    modes=_ARDUPILOT_MODES,
    names={
        "STABILIZE": Mode.MANUAL,
        "ALT_HOLD": Mode.ALTITUDE,
        "GUIDED": Mode.EXTERNAL,
        "LOITER": Mode.POSITION,
        "RTL": Mode.RETURN,
        "LAND": Mode.LAND,
        "BRAKE": Mode.HOLD,
    },
    boot_mode=Mode.MANUAL,
    hover_thrust=0.35,  # MOT_THST_HOVER, its default
    ready_s=42.0,
    refused=mav.MAV_RESULT_FAILED,
    mode_acks_first=False,
    ack_delay_s=(0.0025, 0.0035),
    loop_hz=400.0,
    period_share=1.0,
    least_period_s=1.0 / 333.0,
    refuse_faster=True,
    unknown_stream=mav.MAV_RESULT_FAILED,
    not_forwarded=frozenset(
        {
            mav.MAVLINK_MSG_ID_COMPONENT_METADATA,
            mav.MAVLINK_MSG_ID_EVENT,
            mav.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS,
        }
    ),
    burst=None,
    forward_delay_s=0.004,
    parameters={
        GUIDED_TIMEOUT: 3.0,
        LINK_OPTIONS: 0,
        "MAV_SYSID": 1,
        DISARM_DELAY: 10,
        "FRAME_CLASS": 1,
    },
    bytewise_parameters=False,
    companion_hz={mav.MAVLINK_MSG_ID_HEARTBEAT: 1.0, mav.MAVLINK_MSG_ID_TIMESYNC: 0.1},
    ground_hz={mav.MAVLINK_MSG_ID_HEARTBEAT: 1.0, mav.MAVLINK_MSG_ID_TIMESYNC: 0.1},
)

FLAVOURS: Mapping[str, Flavour] = {flavour.name: flavour for flavour in (PX4, ARDUPILOT)}
