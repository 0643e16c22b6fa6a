"""COMMAND_LONG and COMMAND_INT to the autopilot stand-in: what each does and how it is acknowledged."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from arm_companion.protocol.dialect import mav
from arm_companion.sim.autopilot_flavours import Flavour, Mode
from arm_companion.sim.autopilot_modes import FlightModes
from arm_companion.sim.autopilot_telemetry import HOME_ALTITUDE_M, Telemetry
from arm_companion.sim.mavlink_router import Port

Numbers = tuple[float, ...]
"""param1 to param7; NaN is MAVLink's word for 'not given'."""
_FORCE = 21196.0
_ACCEPTED, _DENIED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED
_UNSUPPORTED = mav.MAV_RESULT_UNSUPPORTED
_SILENT = -1


@dataclass
class GripperOutput:
    """A gripper on the autopilot's output.

    Attributes:
        instance: param1 of DO_GRIPPER that means it.
        closing: where it was told to go last.
        result: that DO_GRIPPER gets; `silent` answers nothing.
    """

    instance: int = 1
    closing: bool = False
    result: int = int(_ACCEPTED)

    def silent(self) -> None:
        """Answer no DO_GRIPPER any more, and obey none."""
        self.result = _SILENT


class Commands:
    """Executes commands.

    Args:
        flavour: decides what is supported and how it is refused.
        modes: arming and flight modes.
        telemetry: for messages that are asked for.
        reboot: power-cycles the autopilot.
        gripper: on one of its outputs.
    """

    def __init__(
        self,
        flavour: Flavour,
        modes: FlightModes,
        telemetry: Telemetry,
        reboot: Callable[[], None],
        gripper: GripperOutput,
    ) -> None:
        self._flavour = flavour
        self._modes = modes
        self._telemetry = telemetry
        self._reboot = reboot
        self._gripper = gripper
        self._mode_of_number: dict[int, Mode] = {}
        for mode, number in flavour.modes.items():
            self._mode_of_number.setdefault(number, mode)
        self._table: dict[int, Callable[[Numbers, float, Port], int]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mav.MAV_CMD_NAV_TAKEOFF: self._takeoff,
            mav.MAV_CMD_NAV_LAND: lambda _p, now, _port: modes.request_mode(Mode.LAND, now),
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _p, now, _port: modes.request_mode(Mode.RETURN, now),
            mav.MAV_CMD_DO_SET_MODE: self._set_mode,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mav.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mav.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._capabilities,
            mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._power,
            mav.MAV_CMD_DO_GRIPPER: self._grip,
        }
        if flavour.is_px4:
            self._table[mav.MAV_CMD_DO_SET_ACTUATOR] = lambda _p, _now, _port: int(_ACCEPTED)

    def handle(self, message: Any, now: float, port: Port) -> list[Any]:
        """Execute the command.

        Returns:
            Its acknowledgements, in order.
        """
        if message.get_type() == "COMMAND_INT":
            rest = (float(message.x), float(message.y), message.z)
        else:
            rest = (message.param5, message.param6, message.param7)
        numbers = (message.param1, message.param2, message.param3, message.param4, *rest)
        acks = []
        if message.command == mav.MAV_CMD_DO_SET_MODE and self._flavour.mode_acks_first:
            acks.append(_ack(message, int(_ACCEPTED)))
        execute = self._table.get(message.command)
        result = int(_UNSUPPORTED) if execute is None else execute(numbers, now, port)
        return [*acks, _ack(message, result)] if result != _SILENT else acks

    def set_mode(self, custom_mode: int, now: float) -> int:
        """The mode of that number, for DO_SET_MODE and the old SET_MODE."""
        mode = self._mode_of_number.get(custom_mode)
        return int(_DENIED) if mode is None else self._modes.request_mode(mode, now)

    def _arm(self, p: Numbers, now: float, _port: Port) -> int:
        force = p[1] == _FORCE
        if p[0] == 1.0:
            return self._modes.arm(now, force=force)
        return self._modes.disarm(force=force) if p[0] == 0.0 else int(_DENIED)

    def _takeoff(self, p: Numbers, now: float, _port: Port) -> int:
        """The altitude is over mean sea level for PX4, which has a default for NaN; over home for ArduPilot."""
        altitude = p[6]
        if self._flavour.is_px4 and math.isnan(altitude):
            return self._modes.request_mode(Mode.TAKEOFF, now)
        if not math.isfinite(altitude):
            return int(_DENIED)
        return self._modes.takeoff(altitude - (HOME_ALTITUDE_M if self._flavour.is_px4 else 0.0))

    def _set_mode(self, p: Numbers, now: float, _port: Port) -> int:
        flags, main, sub = (_whole(number, 0) for number in p[:3])
        if flags is None or main is None or not flags & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return int(_DENIED)
        if not self._flavour.is_px4:
            return self.set_mode(main, now)
        return self.set_mode(main << 16 | (sub or 0) << 24, now)

    def _set_interval(self, p: Numbers, _now: float, port: Port) -> int:
        message = _whole(p[0])
        if message is None or not self._telemetry.knows(message):
            return self._flavour.unknown_stream
        if not math.isfinite(p[1]):
            return int(_DENIED)
        return int(_ACCEPTED if port.streams.request(message, p[1]) else _DENIED)

    def _get_interval(self, p: Numbers, _now: float, port: Port) -> int:
        message = _whole(p[0])
        if message is None or not 0 <= message <= 0xFFFF:
            return int(_DENIED)
        port.send(mav.MAVLink_message_interval_message(message, port.streams.interval_us(message)))
        return int(_ACCEPTED)

    def _request_message(self, p: Numbers, now: float, port: Port) -> int:
        message = _whole(p[0])
        if message == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._get_interval(p[1:], now, port)
        if message is None or not self._telemetry.knows(message):
            return int(_DENIED)
        answer = self._telemetry.build(message)
        if answer is None:
            return int(mav.MAV_RESULT_FAILED)
        port.send(answer)
        return int(_ACCEPTED)

    def _grip(self, p: Numbers, _now: float, _port: Port) -> int:
        """Measured: a gripper is acknowledged at once, also one that does not exist, with nothing moving at all."""
        gripper = self._gripper
        if p[0] == gripper.instance and gripper.result == _ACCEPTED:
            gripper.closing = p[1] == mav.GRIPPER_ACTION_GRAB
        return gripper.result

    def _capabilities(self, p: Numbers, now: float, port: Port) -> int:
        if p[0] != 1.0:
            return int(_DENIED)
        return self._request_message((float(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION),), now, port)

    def _power(self, p: Numbers, _now: float, _port: Port) -> int:
        if self._modes.armed or p[0] != 1.0:
            return int(_DENIED)
        self._reboot()
        return int(_ACCEPTED)


def _whole(number: float, missing: int | None = None) -> int | None:
    """A parameter that names something: None when it is not finite, `missing` for NaN."""
    if math.isnan(number):
        return missing
    return int(number) if math.isfinite(number) else None


def _ack(message: Any, result: int) -> Any:
    return mav.MAVLink_command_ack_message(
        message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
    )
