"""A scripted arm at the far end of a ground station's channel, in simulated time."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from arm_companion.clock import run_simulated
from arm_companion.drivers.status_text import status_texts
from arm_companion.ground.arm import Arm
from arm_companion.ground.channel import Channel
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.tunnel import tunnel

STATION = (245, 190)
NAN = float("nan")


def status_message(state: str = "STOWED", **fields: Any) -> Message:
    """An ARM_STATUS."""
    values: dict[str, Any] = {
        "time_usec": 1_000_000,
        "flags": 0,
        "errors": 0,
        "theta": 0.5,
        "delta": 0.25,
        "tip_position": [0.125, 0.0, 0.25],
        "goal_theta": 0.5,
        "goal_delta": 0.25,
        "behaviour": mav.ARM_BEHAVIOUR_READY,
        "state": mav.ARM_STATE_UNKNOWN,
        "progress": 255,
        "calibration": 0,
        "state_name": state.encode(),
    }
    return mav.MAVLink_arm_status_message(**{**values, **fields})


class ScriptedArm:
    """Component 1/192: keeps what it is sent, and answers as its script says. Everything passes through bytes."""

    def __init__(self) -> None:
        self.received: list[Message] = []
        self.script: Callable[[Message], None] = lambda _: None
        self.through_autopilot = False
        self.beating = True
        self._codecs: dict[tuple[int, int], MavlinkCodec] = {}
        self._reader = MavlinkCodec(0, 0)
        self.channel = Channel(self._from_ground, STATION)
        self.arm = Arm(self.channel)

    async def _from_ground(self, message: Message) -> None:
        (read,) = self._reader.feed(self._codec(STATION).encode(message))
        self.received.append(read)
        self.script(read)

    def _codec(self, source: tuple[int, int]) -> MavlinkCodec:
        return self._codecs.setdefault(source, MavlinkCodec(*source))

    def say(self, message: Message, source: tuple[int, int] = (1, 192)) -> None:
        """Send a message to the station; private ones in TUNNEL when an autopilot stands between."""
        if self.through_autopilot and message.id >= 50_000:
            message = tunnel(self._codec((*source,)).encode(message), 0, 0)
        self.raw(self._codec(source).encode(message))

    def raw(self, data: bytes) -> None:
        """Send bytes to the station."""
        for message in self._reader.feed(data):
            self.channel.receive(message)

    def beat(self, source: tuple[int, int] = (1, 192)) -> None:
        """Send a heartbeat."""
        kind = mav.MAV_TYPE_QUADROTOR if source[1] == 1 else mav.MAV_TYPE_ONBOARD_CONTROLLER
        self.say(mav.MAVLink_heartbeat_message(kind, mav.MAV_AUTOPILOT_INVALID, 0, 0, 3, 3), source)

    def text(self, text: str, severity: int = 4) -> None:
        """Send a sentence."""
        for chunk in status_texts(severity, text, 7):
            self.say(chunk)

    def ack(self, command: int, result: int, progress: int = 0, **more: Any) -> None:
        """Send a COMMAND_ACK; `source` and `target` may differ from what is right."""
        target = more.get("target", STATION)
        message = mav.MAVLink_command_ack_message(command, result, progress, 0, *target)
        self.say(message, more.get("source", (1, 192)))

    def sent(self, name: str) -> list[Message]:
        """What the station sent, of one type."""
        return [message for message in self.received if message.get_type() == name]

    def run(self, main: Callable[[], Coroutine[Any, Any, Any]]) -> Any:
        """Run a test in simulated time, with a heartbeat every second while `beating`."""

        async def beats() -> None:
            while True:
                if self.beating:
                    self.beat()
                await asyncio.sleep(1.0)

        async def both() -> Any:
            beating = asyncio.create_task(beats())
            await asyncio.sleep(0.0)
            try:
                return await main()
            finally:
                beating.cancel()

        return run_simulated(both())


@pytest.fixture
def scripted() -> ScriptedArm:
    """A scripted arm that has a heartbeat."""
    return ScriptedArm()


@pytest.fixture
def make_status() -> Callable[..., Message]:
    """Makes an ARM_STATUS."""
    return status_message
