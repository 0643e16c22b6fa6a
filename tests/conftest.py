"""Another MAVLink system at the far end of an in-memory pipe, for tests in simulated time."""

import hypothesis
import pytest

from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec, Message
from arm_companion.protocol.tunnel import unwrap
from arm_companion.transport.base import Transport
from arm_companion.transport.memory import MemoryPipe
from tests.stalls import AnotherTry

# the same examples in every run: what fails here has been brought in by a change. Others: --hypothesis-profile=default
hypothesis.settings.register_profile("shared machine", deadline=None, derandomize=True)
hypothesis.settings.load_profile("shared machine")


def pytest_configure(config: pytest.Config) -> None:
    """Real-time tests get another try when this machine stood still."""
    config.pluginmanager.register(AnotherTry())


class MavlinkPeer:
    """A system that keeps every message it receives, those inside TUNNEL too."""

    def __init__(self, system: int, component: int) -> None:
        self.codec = MavlinkCodec(system, component)
        self.inner = MavlinkCodec(system, component)
        self.received: list[Message] = []
        self.pipe = MemoryPipe()
        self.transport: Transport | None = None

    async def open(self) -> None:
        """Take end 1 of the pipe; the driver under test has end 0."""
        self.transport = await self.pipe.opener(1)(self.receive)

    def receive(self, data: bytes) -> None:
        for message in self.codec.feed(data):
            self.received.append(message)
            if message.get_type() == "TUNNEL":
                frame = unwrap(message.payload_type, bytes(message.payload))
                self.received += [] if frame is None else self.inner.feed(frame)

    def send(self, *messages: Message) -> None:
        assert self.transport is not None
        for message in messages:
            self.transport.write(self.codec.encode(message))

    def send_raw(self, data: bytes) -> None:
        assert self.transport is not None
        self.transport.write(data)

    def all(self, name: str) -> list[Message]:
        """Messages of one type received so far."""
        return [m for m in self.received if m.get_type() == name]

    def command(self, command: int, *parameters: float, to: tuple[int, int] = (1, 192), confirmation: int = 0) -> None:
        """Send a COMMAND_LONG; missing parameters are 0."""
        filled = (*parameters, *[0.0] * (7 - len(parameters)))
        self.send(mav.MAVLink_command_long_message(*to, command, confirmation, *filled))

    def heartbeat(self, autopilot: int, custom_mode: int, *, armed: bool = True, status: int = 4) -> None:
        """Send a quadrotor's HEARTBEAT."""
        flags = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mav.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
        self.send(mav.MAVLink_heartbeat_message(mav.MAV_TYPE_QUADROTOR, autopilot, flags, custom_mode, status, 3))


@pytest.fixture
def autopilot_peer() -> MavlinkPeer:
    """System 1, component 1."""
    return MavlinkPeer(1, 1)


@pytest.fixture
def ground_peer() -> MavlinkPeer:
    """System 255, component 190."""
    return MavlinkPeer(255, 190)
