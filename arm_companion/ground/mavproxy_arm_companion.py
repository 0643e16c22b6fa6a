"""A MAVProxy module: `module load arm_companion.ground.mavproxy_arm_companion`, then `armc`.

It sends nothing to the arm before its heartbeat has been heard, sends on the link where it was heard, repeats what got
no answer, and believes an acknowledgement only from the arm. State is read from the arm's own messages, which MAVProxy
does not know, direct or inside TUNNEL.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from MAVProxy.modules.lib import mp_module

from arm_companion.ground.commands import RESEND_S, RESULTS, TRIES, name_of
from arm_companion.ground.reports import REPORTS, Report, Status, Tendons, Wrench
from arm_companion.ground.texts import Sentences
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.tunnel import unwrap

NAME: Final = "arm_companion.ground.mavproxy_arm_companion"
"""As it is loaded, so that it can be unloaded by the same name."""
COMPONENT: Final = 192
SILENT_S: Final = 5.0
USAGE: Final = """usage: armc status|ready|perch|hang|grasp|release|stow|abort|clear
       armc jog THETA_DEG [DELTA_DEG]   bend the free arm
       armc vehicle N E D               move the anchored vehicle, m
       armc reach N E D                 bring the tip to a point, m
       armc calibrate yes               the tendons' zeros; yes: nothing touches the arm
       armc control take|release|take-over
       armc component [ID]              component id of the arm"""

_ORDERS: Final = {
    "ready": (mav.MAV_CMD_ARM_READY,),
    "perch": (mav.MAV_CMD_ARM_PERCH,),
    "hang": (mav.MAV_CMD_ARM_PERCH, mav.ARM_PERCH_KIND_HANG),
    "grasp": (mav.MAV_CMD_ARM_GRASP,),
    "release": (mav.MAV_CMD_ARM_RELEASE,),
    "stow": (mav.MAV_CMD_ARM_STOW,),
    "abort": (mav.MAV_CMD_ARM_ABORT,),
    "clear": (mav.MAV_CMD_ARM_CLEAR_ERRORS,),
}
_CONTROL: Final = {
    "release": mav.ARM_CONTROL_RELEASE,
    "take": mav.ARM_CONTROL_TAKE,
    "take-over": mav.ARM_CONTROL_TAKE_OVER,
}


@dataclass(slots=True)
class _Waiting:
    """A command without its final answer."""

    parameters: tuple[float, ...]
    sent_at: float
    sent: int = 1
    running: bool = False


class ArmModule(mp_module.MPModule):  # type: ignore[misc]  # MAVProxy has no types
    """What MAVProxy calls. Made by `init`.

    Args:
        mpstate: MAVProxy's state.
    """

    def __init__(self, mpstate: Any) -> None:
        # multi_vehicle: MAVProxy gives other modules no heartbeats but the autopilot's.
        super().__init__(mpstate, NAME, "continuum arm", multi_vehicle=True)
        self.component = COMPONENT
        self._system = 0
        self._beat_at = -math.inf
        self._sentences = Sentences()
        self._codec = MavlinkCodec(255, 190)
        self._reports: dict[str, Report] = {}
        self._waiting: dict[int, _Waiting] = {}
        verbs = ["<status|jog|vehicle|reach|calibrate|control|component>", *_ORDERS]
        self.add_command("armc", self.command, "continuum arm", verbs)

    # Typed --------------------

    def command(self, words: list[str]) -> None:
        """The `armc` command."""
        verb, *rest = words or ["help"]
        try:
            if verb in _ORDERS and not rest:
                self._order(*_ORDERS[verb])
            elif verb == "status" and not rest:
                print(self.describe())
            elif verb == "jog" and len(rest) in (1, 2):
                theta, delta = (math.radians(float(word)) for word in (*rest, "0")[:2])
                self._order(mav.MAV_CMD_ARM_JOG, mav.ARM_JOG_KIND_BEND, theta, delta)
            elif verb == "vehicle" and len(rest) == 3:
                self._order(mav.MAV_CMD_ARM_JOG, mav.ARM_JOG_KIND_VEHICLE, *(float(word) for word in rest))
            elif verb == "reach" and len(rest) == 3:
                self._order(mav.MAV_CMD_ARM_REACH, mav.ARM_REACH_KIND_TOGETHER, *(float(word) for word in rest))
            elif verb == "calibrate" and rest == ["yes"]:
                self._order(mav.MAV_CMD_ARM_CALIBRATE, mav.ARM_CALIBRATION_STEP_TENDONS, 1)
            elif verb == "control" and len(rest) == 1 and rest[0] in _CONTROL:
                self._order(mav.MAV_CMD_ARM_CONTROL, _CONTROL[rest[0]])
            elif verb == "component" and len(rest) <= 1:
                self._choose(*rest)
            else:
                print(USAGE)
        except ValueError:
            print(USAGE)

    def describe(self) -> str:
        """What the arm tells, in a few lines."""
        if not self._system:
            return f"arm: no heartbeat of component {self.component} yet"
        age = self.get_time() - self._beat_at
        lines = [f"arm {self._system}/{self.component}: " + (f"SILENT for {age:.0f} s" if age > SILENT_S else "heard")]
        status, wrench, tendons = (self._reports.get(kind.MESSAGE) for kind in (Status, Wrench, Tendons))
        if isinstance(status, Status):
            bend = f"bend {math.degrees(status.theta):.1f} deg, asked {math.degrees(status.goal_theta):.1f}"
            lines.append(f"state {status.state} ({status.behaviour}), {bend}")
            lines.append(f"errors: {', '.join(status.errors) or 'none'}")
        if isinstance(tendons, Tendons):
            lines.append("tension, N: " + " ".join(f"{t.tension:.1f}" for t in tendons.tendons))
        if isinstance(wrench, Wrench):
            force = " ".join(f"{f:.2f}" for f in wrench.force)
            lines.append(f"force on the airframe, N: {force}" + ("" if wrench.validity else " (not to be used)"))
        return "\n  ".join(lines)

    def _choose(self, component: str = "") -> None:
        if component:
            if not 1 <= int(component) <= 255:
                raise ValueError
            self.component, self._system = int(component), 0
            self._reports.clear()
            self._waiting.clear()
        print(f"arm: component {self.component}")

    def _order(self, command: int, *parameters: float) -> None:
        if not self._system:
            print(f"arm: no heartbeat of component {self.component} yet, so nothing is sent to it")
            return
        self._waiting[command] = _Waiting((*parameters, *[0.0] * (7 - len(parameters))), self.get_time())
        self._send(command)

    def _send(self, command: int) -> None:
        waiting = self._waiting[command]
        self._link().mav.command_long_send(self._system, self.component, command, waiting.sent - 1, *waiting.parameters)

    def _link(self) -> Any:
        """The link on which the arm was heard: on another one an autopilot may not know it."""
        for number, heard in self.mpstate.vehicle_link_map.items():
            if (self._system, self.component) in heard and number < len(self.mpstate.mav_master):
                return self.mpstate.mav_master[number]
        return self.master

    # Called by MAVProxy --------------------

    def idle_task(self) -> None:
        """Repeat what got no answer."""
        now = self.get_time()
        for command, waiting in list(self._waiting.items()):
            if waiting.running:
                if now - self._beat_at > SILENT_S:
                    del self._waiting[command]
                    self._say(f"not heard for {SILENT_S:.0f} s; {name_of(command)} may be going on")
            elif now - waiting.sent_at > RESEND_S:
                if waiting.sent >= TRIES:
                    del self._waiting[command]
                    self._say(f"no answer to {name_of(command)}, sent {TRIES} times")
                    continue
                waiting.sent, waiting.sent_at = waiting.sent + 1, now
                self._send(command)

    def mavlink_packet(self, packet: Any) -> None:
        """Any message of any link."""
        name = packet.get_type()
        if name.startswith("UNKNOWN_"):  # one of ours: MAVProxy tells nothing of its sender, the frame does
            self._take_frame(bytes(packet.get_msgbuf()))
            return
        if packet.get_srcComponent() != self.component or self._system not in (0, packet.get_srcSystem()):
            return
        takers: dict[str, Callable[[Any], None]] = {
            "HEARTBEAT": self._take_heartbeat,
            "COMMAND_ACK": self._take_ack,
            "STATUSTEXT": self._take_text,
            "TUNNEL": self._take_tunnel,
        }
        if name in takers and (self._system or name == "HEARTBEAT"):
            takers[name](packet)

    def unload(self) -> None:
        """Take the command away."""
        self.remove_command("armc")

    def _take_heartbeat(self, packet: Any) -> None:
        if not self._system:
            self._system = packet.get_srcSystem()
            self._say(f"heard as {self._system}/{self.component}")
        self._beat_at = self.get_time()

    def _take_ack(self, packet: Any) -> None:
        waiting = self._waiting.get(packet.command)
        ours = self.settings.source_system, self.settings.source_component
        if waiting is None or any(
            getattr(packet, field, 0) not in (0, own)
            for field, own in zip(("target_system", "target_component"), ours, strict=True)
        ):
            return
        if packet.result == mav.MAV_RESULT_IN_PROGRESS:
            waiting.running = True
            return
        del self._waiting[packet.command]
        self._say(f"{name_of(packet.command)} {RESULTS.get(packet.result, packet.result)}")

    def _take_text(self, packet: Any) -> None:
        for text in self._sentences.take(packet):
            self._say(f"{text.severity}: {text.text}")

    def _take_tunnel(self, packet: Any) -> None:
        frame = unwrap(packet.payload_type, bytes(packet.payload[: packet.payload_length]))
        if frame is not None:
            self._take_frame(frame)

    def _take_frame(self, frame: bytes) -> None:
        self._codec.reset()
        for message in self._codec.feed(frame):
            if (message.get_srcSystem(), message.get_srcComponent()) == (self._system, self.component):
                self._take_report(message)

    def _take_report(self, message: Message) -> None:
        kind = REPORTS.get(message.get_type())
        if kind is None:
            return
        before = self._reports.get(kind.MESSAGE)
        report = self._reports[kind.MESSAGE] = kind.of(message)
        if isinstance(report, Status) and (not isinstance(before, Status) or before.state != report.state):
            self._say(f"state {report.state}")
            self.console.set_status("Arm", f"Arm {report.state}")

    def _say(self, text: str) -> None:
        print(f"arm: {text}")


def init(mpstate: Any) -> ArmModule:
    """Called by `module load`."""
    return ArmModule(mpstate)
