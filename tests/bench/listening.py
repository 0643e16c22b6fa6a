"""What it costs to listen to an autopilot: 500 messages a second in, 100 of them wanted, over UDP in real time.

Each listener is a process of its own, so that its processor time (all of its threads) can be told from the sender's:
ours is a whole MavlinkLink, beside mavutil's recv_match loop and MAVSDK's subscription.
"""

import asyncio
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from tests.bench.measure import Result

SECONDS = 4.0
WARM_UP_S = 1.0
TICK_S = 0.01
PER_TICK = 5  # 500 messages a second
WANTED = ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED")  # 50 a second each


def listening() -> Iterator[Result]:
    """Share of one core that each listener takes."""
    shares = {name: _measure(name) for name in LISTENERS}
    ours = 100.0 * shares.pop("ours")
    for name, share in shares.items():
        yield Result("MAVLink, listen to 500/s, 100 wanted", ours, "%", PEERS[name], 100.0 * share)


def _measure(name: str) -> float:
    port = free_port()
    command = [sys.executable, "-m", "tests.bench.listening", name, str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "MAVLINK20": "1"}) as listener:
        _send(port, listener)
        output, _ = listener.communicate(timeout=10.0)
    heard = json.loads(output)
    expected = 100.0 * heard["wall"]
    if not 0.8 * expected <= heard["messages"] <= 1.2 * expected:
        raise RuntimeError(f"{name} heard {heard['messages']} of {expected:.0f} messages")
    return float(heard["cpu"]) / float(heard["wall"])


def free_port() -> int:
    """A UDP port of loopback that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _send(port: int, listener: "subprocess.Popen[bytes]") -> None:
    """What an autopilot streams, until the listener has had enough."""
    begun = time.perf_counter()

    def wanted() -> bool:
        if time.perf_counter() - begun > SECONDS + WARM_UP_S + 15.0:
            listener.kill()
            raise RuntimeError("the listener does not end")
        return listener.poll() is None

    stream(port, wanted)


def stream(port: int, wanted: Callable[[], bool]) -> None:
    """500 messages a second to a port, as long as they are wanted."""
    codec = MavlinkCodec(1, 1)
    begun, tick = time.perf_counter(), 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        while wanted():
            for message in _messages(tick):
                out.sendto(codec.encode(message), ("127.0.0.1", port))
            tick += 1
            time.sleep(max(begun + tick * TICK_S - time.perf_counter(), 0.0))


def _messages(tick: int) -> Iterator[mav.MAVLink_message]:
    now = 10 * tick
    if tick % 2:
        yield mav.MAVLink_attitude_quaternion_message(now, 1.0, 0.01, 0.02, 0.03, 0.1, 0.2, 0.3)
    else:
        yield mav.MAVLink_local_position_ned_message(now, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3)
    if tick % 100 == 0:
        yield mav.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3)
    else:
        yield mav.MAVLink_attitude_message(now, 0.1, 0.2, 0.3, 0.1, 0.2, 0.3)
    yield mav.MAVLink_highres_imu_message(1000 * now, *[0.1 * i for i in range(13)], 63)
    yield mav.MAVLink_global_position_int_message(now, 1, 2, 3, 4, 5, 6, 7, 8)
    yield mav.MAVLink_vfr_hud_message(1.0, 2.0, 90, 50, 3.0, 0.1)


class _Meter:
    """Counts messages and processor time once the listener is warm."""

    def __init__(self) -> None:
        self.messages = 0
        self._first: float | None = None
        self._from = (0.0, 0.0)

    def count(self) -> None:
        now = time.perf_counter()
        if self._first is None:
            self._first = now
        if now - self._first < WARM_UP_S:
            self._from = (now, time.process_time())
        else:
            self.messages += 1

    @property
    def full(self) -> bool:
        return self._first is not None and time.perf_counter() - self._first > WARM_UP_S + SECONDS

    def say(self) -> None:
        wall, cpu = time.perf_counter() - self._from[0], time.process_time() - self._from[1]
        print(json.dumps({"messages": self.messages, "wall": wall, "cpu": cpu}), flush=True)


async def _until_full(meter: _Meter) -> None:
    while not meter.full:  # noqa: ASYNC110 - the meter only counts
        await asyncio.sleep(0.1)
    meter.say()


def _ours(port: int) -> None:
    from arm_companion.clock import precise_loop
    from arm_companion.config.schema import VehicleConfig
    from arm_companion.drivers.mavlink_link import MavlinkLink
    from arm_companion.transport.udp import udp_in

    async def main() -> None:
        meter = _Meter()
        link = MavlinkLink("autopilot", "autopilot", udp_in("127.0.0.1", port), VehicleConfig())
        link.subscribe(lambda *_: meter.count(), [getattr(mav, f"MAVLINK_MSG_ID_{name}") for name in WANTED])
        task = asyncio.create_task(link.run())
        await _until_full(meter)
        task.cancel()

    with asyncio.Runner(loop_factory=precise_loop) as runner:
        runner.run(main())


def _mavutil(port: int) -> None:
    from pymavlink import mavutil

    meter = _Meter()
    connection = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}")
    while not meter.full:
        if connection.recv_match(type=list(WANTED), blocking=True, timeout=1.0) is not None:
            meter.count()
    meter.say()
    connection.close()


def _mavsdk(port: int) -> None:
    from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
    from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync

    async def main() -> None:
        meter = _Meter()
        async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
            await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            while not (systems := await mavsdk.get_systems()):  # noqa: ASYNC110 - MAVSDK's threads set no event
                await asyncio.sleep(0.05)
            direct = MavlinkDirectAsync(systems[0])

            async def listen(name: str) -> None:
                async for message in direct.subscribe_message(name):
                    json.loads(message.fields_json)
                    meter.count()

            tasks = [asyncio.create_task(listen(name)) for name in WANTED]
            await _until_full(meter)
            for task in tasks:
                task.cancel()
            os._exit(0)  # its threads need long to end

    asyncio.run(main())


LISTENERS = {"ours": _ours, "mavutil": _mavutil, "mavsdk": _mavsdk}
PEERS = {"mavutil": "mavutil recv_match", "mavsdk": "MAVSDK subscription"}

if __name__ == "__main__":
    LISTENERS[sys.argv[1]](int(sys.argv[2]))
