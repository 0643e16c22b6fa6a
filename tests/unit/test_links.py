"""Links by their configuration: bandwidth, signing, forwarding, keys on disk, and what their counters tell."""

import asyncio
import contextlib
import dataclasses
import itertools
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import Config
from arm_companion.config.schema import LinkConfig, MavlinkConfig, VehicleConfig
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.forwarding import Forwarding
from arm_companion.drivers.keeper import Keeper
from arm_companion.drivers.link_watch import LinkWatch
from arm_companion.drivers.mavlink_link import MavlinkLink, Priority
from arm_companion.drivers.signing_keys import SigningKeys, read_key
from arm_companion.drivers.vehicle_check import VehicleCheck
from arm_companion.errors import ConfigError
from arm_companion.mission.facts import Notice, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.mavlink_frames import Header
from arm_companion.protocol.signing import Signing, stamp_at
from tests.conftest import MavlinkPeer
from tests.unit.component_rig import GCS, ServiceRig, serve

KEY = bytes(range(32))
VEHICLE = VehicleConfig(system_id=1)


def ping(number: int, to: tuple[int, int] = (1, 1)) -> Any:
    return mav.MAVLink_ping_message(number, number, *to)


def sealed(peer: MavlinkPeer, key: bytes = KEY) -> None:
    """Let a peer sign as of now."""
    signing = Signing(key, 9)
    loop = asyncio.get_running_loop()
    peer.codec.seal = lambda frame: signing.sign(frame, SIMULATED_EPOCH_S + loop.time())


# --- bandwidth ---


def test_a_slow_line_carries_what_it_can_the_urgent_first_and_the_newest() -> None:
    async def main() -> None:
        peer = MavlinkPeer(255, 190)
        config = LinkConfig("", bandwidth_bytes_per_s=1000.0)
        link = MavlinkLink("slow", "ground", peer.pipe.opener(0), VEHICLE, config=config)
        await peer.open()
        task = asyncio.create_task(link.run())
        await asyncio.sleep(0.01)
        for i in range(100):
            link.send(ping(i), Priority.BULK)
        link.send(GCS)
        start = asyncio.get_running_loop().time()
        await asyncio.sleep(0.5)
        sizes = [len(m.get_msgbuf()) for m in peer.received]
        assert sum(sizes) == pytest.approx(500, abs=60)
        assert peer.received[1].get_type() == "HEARTBEAT"
        await asyncio.sleep(2.0)
        numbers = [m.seq for m in peer.all("PING")]
        assert numbers == [0, *range(68, 100)]
        assert link.counters.crowded_out == 67
        assert asyncio.get_running_loop().time() - start > 1.0
        status = LinkWatch(link).message(1234.5678)
        assert (status.messages_sent, status.tx_overflows) == (34, 67)
        assert status.timestamp == 1_234_567, "ms since boot"
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_simulated(main())


def setpoint() -> Any:
    return mav.MAVLink_set_position_target_local_ned_message(1, 1, 1, 1, 1024, *[1.0] * 9, 1.0, 0.5)


@contextlib.asynccontextmanager
async def to_slow_autopilot(bandwidth: float = 5760.0) -> AsyncIterator[tuple[MavlinkLink, MavlinkPeer]]:
    peer = MavlinkPeer(1, 1)
    config = LinkConfig("", "autopilot", bandwidth_bytes_per_s=bandwidth)
    vehicle = dataclasses.replace(VEHICLE, autopilot="ardupilot")
    link = MavlinkLink("slow", "autopilot", peer.pipe.opener(0), vehicle, config=config)
    await peer.open()
    task = asyncio.create_task(link.run())
    await asyncio.sleep(0.01)
    try:
        yield link, peer
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def stream_setpoints(link: MavlinkLink, seconds: int) -> None:
    """At 100 Hz, which 57600 bit/s cannot carry, with a heartbeat a second and telemetry that is too much, too."""
    for cycle in range(100 * seconds):
        if cycle % 100 == 0:
            link.send(GCS)
        link.send(setpoint(), Priority.NOW)
        link.send(ping(cycle), Priority.BULK)
        await asyncio.sleep(0.01)


def test_setpoints_that_are_more_than_the_line_takes_leave_a_share_of_it() -> None:
    async def main() -> None:
        async with to_slow_autopilot() as (link, peer):
            await stream_setpoints(link, 60)
            sizes = [len(m.get_msgbuf()) for m in peer.received]
            assert sum(sizes) / 60 == pytest.approx(5760, rel=0.02)  # the line is never asked for more than it takes
            assert len(peer.all("HEARTBEAT")) == 60
            assert len(peer.all("SET_POSITION_TARGET_LOCAL_NED")) > 60 * 60
            assert sum(len(m.get_msgbuf()) for m in peer.all("PING")) > 0.2 * 5760 * 60
            peer.received.clear()
            link.send(GCS)
            await asyncio.sleep(0.1)
            assert peer.all("HEARTBEAT")  # nothing is owed when the set-points end
            assert link.counters.late > 0

    run_simulated(main())


def test_an_answer_waits_little_for_setpoints() -> None:
    async def main() -> None:
        async with to_slow_autopilot() as (link, peer):
            for cycle in range(1000):
                link.send(setpoint(), Priority.NOW)
                if cycle == 900:
                    link.send(GCS)
                if cycle == 906:
                    assert len(peer.all("HEARTBEAT")) == 1
                await asyncio.sleep(0.01)

    run_simulated(main())


def test_a_link_that_is_opened_again_owes_nothing() -> None:
    async def main() -> None:
        async with to_slow_autopilot(100.0) as (link, _):
            for late in (5, 10):
                for _ in range(10):
                    link.send(setpoint(), Priority.NOW)
                assert link.counters.late == late
                link.close()
                await asyncio.sleep(0.5)
                assert link.connected

    run_simulated(main())


def test_setpoints_that_fit_are_never_left_out() -> None:
    async def main() -> None:
        async with to_slow_autopilot(11520.0) as (link, peer):
            await stream_setpoints(link, 20)
            assert link.counters.late == 0
            assert len(peer.all("SET_POSITION_TARGET_LOCAL_NED")) == 2000

    run_simulated(main())


def test_people_are_told_once_of_a_line_that_is_too_slow_for_setpoints() -> None:
    async def main() -> None:
        async with to_slow_autopilot() as (link, peer):
            said: list[Notice] = []
            vehicle = dataclasses.replace(VEHICLE, autopilot="ardupilot")
            check = VehicleCheck(link, Autopilot(link, vehicle), vehicle, MavlinkConfig(), said.append)
            task = asyncio.create_task(check.run())
            peer.heartbeat(mav.MAV_AUTOPILOT_ARDUPILOTMEGA, 4)
            await stream_setpoints(link, 60)
            (text,) = (notice.text for notice in said if "bytes/s" in notice.text)
            assert "takes only 5760 bytes/s" in text
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    run_simulated(main())


@pytest.mark.parametrize(("url", "expected"), [("serial:/dev/ttyX:57600", 5760.0), ("udpin:127.0.0.1:1", 0.0)])
def test_a_serial_line_limits_itself(url: str, expected: float) -> None:
    async def nothing(_: Any) -> Any: ...

    assert MavlinkLink("x", "ground", nothing, VEHICLE, config=LinkConfig(url))._bandwidth == expected


def test_rates_of_a_link_are_checked() -> None:
    with pytest.raises(ConfigError, match="rates_hz names ARM_NONSENSE"):
        LinkConfig("", rates_hz={"ARM_NONSENSE": 1.0})


def test_a_link_has_rates_of_its_own() -> None:
    async def body(rig: ServiceRig) -> None:
        for name, expected in (("autopilot", 50_000), ("ground", 500_000)):
            (link,) = (link for link in rig.links if link.name == name)
            assert link.streams.interval_us(mav.MAVLINK_MSG_ID_ARM_REACTION_WRENCH) == expected
        assert rig.links[0].streams.interval_us(mav.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT) == 1_000_000
        assert rig.links[1].streams.interval_us(mav.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT) == -1

    serve(body, links={"ground": {"rates_hz": {"ARM_REACTION_WRENCH": 2.0}}})


# --- signing ---


def test_on_a_signing_link_only_who_has_the_key_is_heard() -> None:
    async def body(rig: ServiceRig) -> None:
        signing = Signing(KEY, 0)
        rig.links[1].secure(signing, lambda: SIMULATED_EPOCH_S + asyncio.get_running_loop().time())
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        sealed(rig.ground, bytes(32))
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        await asyncio.sleep(0.05)
        assert rig.component.take() == ([], None)
        assert rig.links[1].codec.counters.refused == 2
        sealed(rig.ground)
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        await asyncio.sleep(0.05)
        assert len(rig.component.take()[0]) == 1
        rig.component.notify(Notice(Severity.INFO, "hello"))
        await asyncio.sleep(0.05)
        assert rig.ground.received[-1].get_signed()

    serve(body)


def test_a_recorded_command_cannot_be_played_again() -> None:
    async def body(rig: ServiceRig) -> None:
        signing = Signing(KEY, 0)
        rig.links[1].secure(signing, lambda: SIMULATED_EPOCH_S + asyncio.get_running_loop().time())
        sealed(rig.ground)
        frame = rig.ground.codec.encode(mav.MAVLink_command_long_message(1, 192, mav.MAV_CMD_ARM_READY, 0, *[0.0] * 7))
        for _ in range(5):
            rig.ground.send_raw(frame)
            await asyncio.sleep(5.0)
        assert len(rig.component.take()[0]) == 1
        assert rig.links[1].codec.counters.refused == 4

    serve(body)


@pytest.mark.parametrize(("policy", "moved"), [("listen", False), ("accept", True)])
def test_unsigned_peers_are_heard_or_obeyed_as_configured(policy: str, moved: bool) -> None:
    async def body(rig: ServiceRig) -> None:
        rig.links[1].secure(Signing(KEY), lambda: SIMULATED_EPOCH_S)
        rig.ground.command(mav.MAV_CMD_ARM_READY)
        rig.ground.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 64001, 20_000)
        rig.ground.send(mav.MAVLink_param_set_message(1, 192, b"PERCH_STANDOFF", 0.8, 9))
        rig.ground.send(mav.MAVLink_timesync_message(0, 5))
        await asyncio.sleep(0.05)
        assert bool(rig.component.take()[0]) is moved
        assert (rig.settings.config.perch.standoff_m == pytest.approx(0.8)) is moved
        assert rig.ground.all("TIMESYNC")
        assert ("the sender does not sign" in rig.words()) is not moved

    serve(body, links={"ground": {"unsigned": policy}})


def test_a_key_file_must_be_private_and_a_key(tmp_path: Path) -> None:
    file = tmp_path / "key"
    with pytest.raises(ConfigError, match="No such file"):
        read_key(file)
    file.write_bytes(KEY)
    file.chmod(0o640)
    with pytest.raises(ConfigError, match=r"mode 0640\); chmod 600"):
        read_key(file)
    file.chmod(0o600)
    assert read_key(file) == KEY
    file.write_text(KEY.hex() + "\n")
    assert read_key(file) == KEY
    for wrong in (b"", b"zz" * 32, KEY + KEY):
        file.write_bytes(wrong)
        with pytest.raises(ConfigError, match="neither 32 bytes"):
            read_key(file)


def signing_config(directory: Path) -> Config:
    key = directory / "key"
    key.write_bytes(KEY)
    key.chmod(0o600)
    return dataclasses.replace(
        Config(),
        links={"ground": LinkConfig("", signing_key=str(key)), "open": LinkConfig("")},
        mavlink=MavlinkConfig(state_directory=str(directory)),
    )


class Start:
    """A start of the daemon as signing sees it, with a clock that is wrong by `off_s`."""

    def __init__(self, config: Config, off_s: float = 0.0) -> None:
        self.keeper = Keeper()
        self.keys = SigningKeys(config, self.keeper)
        self.signing = self.keys._by_link["ground"]
        self.keys.secure([], Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S + off_s))
        self.off_s = off_s
        self.used: list[int] = []

    async def live(self, seconds: int, *, orderly: bool = False) -> None:
        """Send a frame ten times a second; then the power is cut, unless it is an orderly end."""
        task = asyncio.create_task(self.keys.run())
        codec = MavlinkCodec(1, 192)
        for _ in range(10 * seconds):
            await asyncio.sleep(0.1)
            self.signing.sign(codec.encode(GCS), right_time() + self.off_s)
            self.used.append(self.signing.stamp)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        if orderly:
            self.keys.keep()
        self.keeper.close()


def right_time() -> float:
    return SIMULATED_EPOCH_S + asyncio.get_running_loop().time()


@pytest.mark.parametrize("off_s", [-1e6, -12.0, -5.0, 0.0])
def test_no_time_stamp_is_used_twice_whatever_clock_follows_a_power_cut(tmp_path: Path, off_s: float) -> None:
    config = signing_config(tmp_path)

    async def main() -> None:
        newest = 0
        for off in (0.0, off_s, off_s, 0.0):
            start = Start(config, off)
            await start.live(19)
            assert newest < start.used[0]
            assert start.used == sorted(set(start.used))
            newest = start.used[-1]

    run_simulated(main())


def test_a_peer_that_is_ahead_pulls_our_time_stamps_along_and_none_is_used_twice(tmp_path: Path) -> None:
    config = signing_config(tmp_path)

    async def main() -> None:
        start = Start(config)
        pulls = asyncio.create_task(start.live(35))
        for _ in range(34):
            await asyncio.sleep(1.0)
            start.signing.stamp = stamp_at(right_time() + 1000.0)
        await pulls
        again = Start(config)
        await again.live(1)
        assert start.used[-1] < again.used[0]

    run_simulated(main())


@pytest.mark.parametrize(("seconds", "orderly"), [(4, True), (4, False), (11, False)])
def test_restarts_in_a_row_lock_no_ground_station_out(tmp_path: Path, seconds: int, orderly: bool) -> None:
    config = signing_config(tmp_path)

    async def main() -> None:
        ground, codec = Signing(KEY, 9), MavlinkCodec(255, 190)
        newest = 0
        for _ in range(20):
            start = Start(config)
            await start.live(seconds, orderly=orderly)
            assert newest < start.used[0]
            newest = start.used[-1]
            frame = ground.sign(codec.encode(GCS), right_time())
            head = Header(1, 0, 255, 190, 0, 0, 10, len(frame) - 15)
            assert start.signing.accept(frame, head, right_time())

    run_simulated(main())


def test_a_frame_counts_once_on_whichever_of_the_links_with_its_key_it_comes(tmp_path: Path) -> None:
    config = signing_config(tmp_path)
    other = tmp_path / "other"
    other.write_bytes(bytes(32))
    other.chmod(0o600)
    ground = config.links["ground"]
    links = {"ground": ground, "radio": ground, "else": dataclasses.replace(ground, signing_key=str(other))}
    keys = SigningKeys(dataclasses.replace(config, links=links), Keeper())
    sender, codec, head = Signing(KEY, 3), MavlinkCodec(255, 190), Header(1, 0, 255, 190, 0, 0, 10, 19)
    old, new = (sender.sign(codec.encode(GCS), SIMULATED_EPOCH_S) for _ in range(2))
    assert keys._by_link["ground"].accept(old, head, SIMULATED_EPOCH_S)
    assert not keys._by_link["radio"].accept(old, head, SIMULATED_EPOCH_S + 30.0), "played back"
    assert keys._by_link["radio"].accept(new, head, SIMULATED_EPOCH_S)
    assert not keys._by_link["else"].accept(new, head, SIMULATED_EPOCH_S)
    stranger = Signing(bytes(32), 3).sign(codec.encode(GCS), SIMULATED_EPOCH_S)
    assert keys._by_link["else"].accept(stranger, head, SIMULATED_EPOCH_S), "another key has other senders"


def test_time_stamps_go_on_after_a_restart_with_a_wrong_clock(tmp_path: Path) -> None:
    config = signing_config(tmp_path)
    later = stamp_at(SIMULATED_EPOCH_S + 1e6)

    async def main() -> None:
        keeper = Keeper()
        first = SigningKeys(config, keeper)
        first._by_link["ground"].stamp = later
        first.keep()
        keeper.close()
        second = SigningKeys(config, keeper)
        peer = MavlinkPeer(255, 190)
        link = MavlinkLink("ground", "ground", peer.pipe.opener(0), VEHICLE, config=config.links["ground"])
        second.secure([link], Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S))
        assert link.signing is not None
        assert link.signing.stamp == later  # the daemon ended as it should: exactly as much is used
        link.codec.encode(GCS)
        assert link.signing.stamp == later + 1
        (tmp_path / "signing-ground").write_text("rubbish")
        assert SigningKeys(config, keeper)._by_link["ground"].stamp == 0

    asyncio.run(main())


# --- half a frame ---


@pytest.mark.parametrize(
    ("url", "pause_s", "arrives"),
    [
        ("tcp:ground:5760", 0.3, True),
        ("tcpin:0.0.0.0:5760", 0.3, True),
        ("tcp:ground:5760", 1.1, False),
        ("serial:/dev/radio:57600", 0.25, True),
        ("serial:/dev/radio:57600", 0.4, False),
        ("udpin:0.0.0.0:14540", 0.3, False),
    ],
)
def test_the_second_half_of_a_frame_is_waited_for_as_long_as_its_way_may_pause(
    url: str, pause_s: float, arrives: bool
) -> None:
    async def main() -> None:
        peer = MavlinkPeer(255, 190)
        await peer.open()
        link = MavlinkLink("ground", "ground", peer.pipe.opener(0), VEHICLE, config=LinkConfig(url))
        heard: list[str] = []
        link.subscribe(lambda message, _: heard.append(message.get_type()))
        running = asyncio.create_task(link.run())
        await asyncio.sleep(0.1)
        frame = peer.codec.encode(ping(1, (1, 192)))
        peer.send_raw(frame[:9])
        await asyncio.sleep(pause_s)
        peer.send_raw(frame[9:])
        await asyncio.sleep(0.1)
        assert heard == ["PING"] * arrives
        running.cancel()

    run_simulated(main())


# --- forwarding ---


@contextlib.asynccontextmanager
async def network(names: str, forward: str) -> AsyncIterator[tuple[list[MavlinkLink], list[MavlinkPeer], Forwarding]]:
    """Links a, b, c, ... to systems 11, 12, 13, ..., of which some forward."""
    peers = [MavlinkPeer(11 + i, 1) for i in range(len(names))]
    links = [
        MavlinkLink(name, "ground", peer.pipe.opener(0), VEHICLE, config=LinkConfig("", forward=name in forward))
        for name, peer in zip(names, peers, strict=True)
    ]
    forwarding = Forwarding([link for link in links if link.config.forward])
    for peer in peers:
        await peer.open()
    tasks = [asyncio.create_task(link.run()) for link in links]
    await asyncio.sleep(0.01)
    try:
        yield links, peers, forwarding
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


Net = Callable[[list[MavlinkLink], list[MavlinkPeer], Forwarding], Coroutine[Any, Any, None]]


def route(body: Net, names: str = "abc", forward: str = "abc") -> None:
    async def main() -> None:
        async with network(names, forward) as (links, peers, forwarding):
            await body(links, peers, forwarding)

    run_simulated(main())


def senders(peer: MavlinkPeer, name: str) -> list[int]:
    return [m.get_srcSystem() for m in peer.all(name)]


def test_what_is_for_everybody_goes_everywhere_but_back() -> None:
    async def body(_: Any, peers: list[MavlinkPeer], forwarding: Forwarding) -> None:
        peers[0].send(GCS)
        unknown = bytearray(peers[0].codec.encode(GCS))
        unknown[7:10] = b"\x11\xee\x00"  # an id that we do not know
        peers[0].send_raw(bytes(unknown))
        await asyncio.sleep(0.1)
        assert [senders(peer, "HEARTBEAT") for peer in peers] == [[], [11], [11]]
        assert [peer.codec.counters.unknown for peer in peers] == [0, 1, 1]
        assert forwarding.counters.frames == 4

    route(body)


def test_what_is_for_one_goes_where_he_was_heard_and_nowhere_else() -> None:
    async def body(_: Any, peers: list[MavlinkPeer], forwarding: Forwarding) -> None:
        peers[0].send(ping(1, (12, 1)))
        await asyncio.sleep(0.1)
        assert forwarding.counters.unrouted == 1
        peers[1].send(GCS)
        await asyncio.sleep(0.1)
        for to in ((12, 1), (12, 0), (12, 7), (1, 192)):
            peers[0].send(ping(2, to))
        await asyncio.sleep(0.1)
        assert [(m.target_system, m.target_component) for m in peers[1].all("PING")] == [(12, 1), (12, 0)]
        assert peers[2].all("PING") == []

    route(body)


def test_frames_pass_unchanged_with_their_sequence_and_signature() -> None:
    async def body(_: Any, peers: list[MavlinkPeer], __: Forwarding) -> None:
        sealed(peers[0])
        frames = []
        for i in range(3):
            frames.append(peers[0].codec.encode(ping(i, (0, 0))))
            peers[0].send_raw(frames[-1])
        await asyncio.sleep(0.1)
        assert [bytes(m.get_msgbuf()) for m in peers[1].received] == frames

    route(body)


def test_links_that_do_not_forward_and_keys_and_echoes_stay_out() -> None:
    async def body(links: list[MavlinkLink], peers: list[MavlinkPeer], forwarding: Forwarding) -> None:
        peers[0].send(mav.MAVLink_setup_signing_message(0, 0, list(KEY), 0))
        peers[2].send(GCS)
        peers[0].codec.system_id, peers[0].codec._sender.srcComponent = 1, 192
        peers[0].send(GCS)  # our own heartbeat, by a loop in the network
        await asyncio.sleep(0.1)
        assert [peer.received for peer in peers] == [[], [], []]
        assert forwarding.counters.echoes == 1
        assert links[1].counters.forwarded == 0

    route(body, forward="ab")


def test_what_a_radio_says_of_itself_is_not_forwarded() -> None:
    async def body(_: Any, peers: list[MavlinkPeer], forwarding: Forwarding) -> None:
        report = bytearray(peers[0].codec.encode(mav.MAVLink_radio_status_message(180, 180, 5, 40, 40, 0, 0)))
        peers[0].send_raw(bytes(report))
        report[7] = 166  # RADIO, as older ones call it
        peers[0].send_raw(bytes(report))
        await asyncio.sleep(0.1)
        assert [(peer.received, peer.codec.counters.unknown) for peer in peers] == [([], 0)] * 3
        assert forwarding.counters.frames == 0

    route(body)


def test_what_a_signing_link_refuses_is_not_forwarded() -> None:
    async def body(links: list[MavlinkLink], peers: list[MavlinkPeer], _: Forwarding) -> None:
        links[0].secure(Signing(KEY), lambda: SIMULATED_EPOCH_S)
        peers[0].send(GCS)
        await asyncio.sleep(0.1)
        assert peers[1].received == []
        sealed(peers[0])
        peers[0].send(GCS)
        await asyncio.sleep(0.1)
        assert senders(peers[1], "HEARTBEAT") == [11]

    route(body)


@pytest.mark.parametrize(("unsigned", "arrives"), [("listen", False), ("accept", True)])
def test_who_may_only_tell_asks_nothing_of_the_autopilot_through_us(unsigned: str, arrives: bool) -> None:
    async def body(links: list[MavlinkLink], peers: list[MavlinkPeer], _: Forwarding) -> None:
        links[0].config = dataclasses.replace(links[0].config, unsigned=unsigned)
        links[1].role = "autopilot"
        links[0].secure(Signing(KEY), lambda: SIMULATED_EPOCH_S)
        for peer in peers[1:]:
            peer.send(GCS)
        arm = mav.MAVLink_command_long_message(12, 1, mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0, 21196, 0, 0, 0, 0, 0)
        await asyncio.sleep(0.1)
        peers[0].send(GCS, arm)
        await asyncio.sleep(0.1)
        assert bool(peers[1].all("COMMAND_LONG")) is arrives
        assert bool(senders(peers[1], "HEARTBEAT").count(11)) is arrives
        assert senders(peers[2], "HEARTBEAT") == [12, 11], "the ground is told"
        sealed(peers[0])
        peers[0].send(arm)
        await asyncio.sleep(0.1)
        assert peers[1].all("COMMAND_LONG")

    route(body)


def test_a_flood_on_one_link_delays_no_other() -> None:
    async def body(links: list[MavlinkLink], peers: list[MavlinkPeer], _: Forwarding) -> None:
        arrivals: list[float] = []
        loop = asyncio.get_running_loop()
        peers[2].transport.receiver = lambda _: arrivals.append(loop.time())  # type: ignore[union-attr]
        for tick in range(100):
            peers[0].send(*(ping(i, (12, 1)) for i in range(20)))
            if tick % 10 == 0:
                links[2].send(GCS)
            await asyncio.sleep(0.01)
        assert all(b - a == pytest.approx(0.1, abs=1e-6) for a, b in itertools.pairwise(arrivals))

    route(body)
