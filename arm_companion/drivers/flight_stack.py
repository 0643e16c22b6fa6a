"""What differs between the flight stacks: modes, and how an autopilot is told from everybody else."""

from typing import Final

from arm_companion.config.schema import VehicleConfig
from arm_companion.mission.facts import Control
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

AUTOPILOT_COMPONENT: Final = mav.MAV_COMP_ID_AUTOPILOT1

_EMERGENCIES: Final = frozenset({mav.MAV_STATE_CRITICAL, mav.MAV_STATE_EMERGENCY, mav.MAV_STATE_FLIGHT_TERMINATION})

_STACKS: Final = {"px4": mav.MAV_AUTOPILOT_PX4, "ardupilot": mav.MAV_AUTOPILOT_ARDUPILOTMEGA}

_PX4_OFFBOARD: Final = 6
_PX4_AUTO: Final = 4
_PX4_MAIN: Final = {
    1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 4: "AUTO", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED",
}  # fmt: skip
_PX4_SUB: Final = {
    1: "READY", 2: "TAKEOFF", 3: "LOITER", 4: "MISSION", 5: "RTL", 6: "LAND", 8: "FOLLOW", 9: "PRECLAND",
}  # fmt: skip

_COPTER_GUIDED: Final = 4
_COPTER: Final = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE",
    9: "LAND", 11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW",
    19: "AVOID_ADSB", 20: "GUIDED_NOGPS", 21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG",
    25: "SYSTEMID", 26: "AUTOROTATE", 27: "AUTO_RTL",
}  # fmt: skip


def from_autopilot(heartbeat: Message) -> bool:
    """Whether a HEARTBEAT is that of a flight controller (not of a ground station, camera, companion)."""
    return bool(
        heartbeat.get_srcComponent() == AUTOPILOT_COMPONENT
        and heartbeat.get_srcSystem() != 0
        and heartbeat.autopilot != mav.MAV_AUTOPILOT_INVALID
        and heartbeat.type != mav.MAV_TYPE_GCS
    )


def fits(heartbeat: Message, flavour: str) -> bool:
    """Whether the flight stack is the configured one; its modes would be misread otherwise."""
    return bool(heartbeat.autopilot == _STACKS[flavour])


def control_of(heartbeat: Message, flavour: str) -> Control:
    """Who flies the vehicle, by the autopilot's own heartbeat."""
    if not fits(heartbeat, flavour):
        return Control.UNKNOWN
    if heartbeat.system_status in _EMERGENCIES:
        return Control.FAILSAFE
    if flavour == "px4":
        external = (heartbeat.custom_mode >> 16) & 0xFF == _PX4_OFFBOARD
    else:
        external = heartbeat.custom_mode == _COPTER_GUIDED
    return Control.EXTERNAL if external else Control.PILOT


def mode_name(heartbeat: Message, flavour: str) -> str:
    """Name of the mode as the flight stack's own tools show it."""
    if not fits(heartbeat, flavour):
        return f"unexpected autopilot {heartbeat.autopilot}"
    mode = heartbeat.custom_mode
    if flavour == "ardupilot":
        return _COPTER.get(mode, f"mode {mode}")
    main, sub = (mode >> 16) & 0xFF, (mode >> 24) & 0xFF
    name = _PX4_MAIN.get(main, f"mode {main}")
    return f"{name}.{_PX4_SUB.get(sub, sub)}" if main == _PX4_AUTO else name


class AutopilotFinder:
    """Which system the autopilot is: the first heard, until it falls silent and another speaks.

    One that was armed when it was heard last stays ours however long it is silent: it may still fly, and another
    vehicle in reach of the link must not get its set-points.
    """

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._timeout_s = vehicle.heartbeat_timeout_s
        self._fixed = bool(vehicle.system_id)
        self.system_id = vehicle.system_id
        """System id of the autopilot; 0 until it has been heard."""
        self.stranger = 0
        """System that would be the autopilot now, had ours not been armed; 0: none, or ours speaks again."""
        self._armed = False
        self._last = float("-inf")

    def heard(self, heartbeat: Message, now: float) -> bool:
        """Take a HEARTBEAT; whether it is that of our autopilot."""
        if not from_autopilot(heartbeat):
            return False
        system = heartbeat.get_srcSystem()
        silent = now - self._last > self._timeout_s
        if self.system_id == 0 or (not self._fixed and silent and not self._armed):
            self.system_id = system
        if system != self.system_id:
            if silent and not self._fixed:
                self.stranger = system
            return False
        self._last = now
        self._armed = bool(heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
        self.stranger = 0
        return True
