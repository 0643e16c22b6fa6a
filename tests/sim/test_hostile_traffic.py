"""Everything bad at once, for a long time: noise, damaged and replayed frames, strangers, wrong addresses, NaN, floods.

What must come of it: no order that was not allowed, no changed parameter, no error in a handler, and no growth. A
good order in between works all the time.
"""

import asyncio
import gc
import math
import random
import tracemalloc
from collections import Counter
from typing import Any

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S, run_simulated
from arm_companion.mission.facts import Answer, Order, Result
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.signing import Signing
from arm_companion.protocol.tunnel import tunnel
from tests.unit.component_rig import GCS, ServiceRig, service_rig

KEY = bytes(range(32))
NAN = math.nan
STEP_S = 0.05
ORDERS = [getattr(mav, f"MAV_CMD_ARM_{order.name}") for order in Order]


class Attacker:
    """Makes hostile bytes. It knows the dialect and everything that was ever sent, but not the key."""

    def __init__(self, seed: int, recorded: list[bytes]) -> None:
        self.random = random.Random(seed)
        self.recorded = recorded
        self.kinds = [self.noise, self.damaged, self.replay, self.unsigned, self.wrong_key, self.random_message]
        self.tunnelled_too = [*self.kinds, self.carried]

    def address(self) -> tuple[int, int]:
        return self.random.choice([(1, 192), (1, 192), (1, 0), (0, 0), (1, 1), (2, 192), (255, 190)])

    def sender(self) -> MavlinkCodec:
        return MavlinkCodec(*self.random.choice([(255, 190), (245, 190), (1, 1), (1, 192), (9, 9), (0, 0)]))

    def message(self) -> Any:
        numbers = [self.random.choice([NAN, math.inf, -math.inf, 0.0, 1.0, 1e9, -3.0, 192.0]) for _ in range(7)]
        to = self.address()
        command = self.random.choice([*ORDERS, *range(64_000, 64_012), 211, 187, 246, 400, 511, 512, 510])
        name = self.random.choice([b"PERCH_STANDOFF", b"VEH_COMPID", b"NOTHING", b"\xff" * 16])
        x, y, z = numbers[:3]
        return self.random.choice(
            [
                mav.MAVLink_command_long_message(*to, command, self.random.randrange(3), *numbers),
                mav.MAVLink_command_int_message(*to, 0, command, 0, 0, *numbers[:4], 5, -5, NAN),
                mav.MAVLink_command_cancel_message(*to, command),
                mav.MAVLink_param_set_message(*to, name, numbers[0], self.random.choice([6, 9, 1])),
                mav.MAVLink_param_ext_set_message(*to, name, self.random.randbytes(8), self.random.choice([6, 9])),
                mav.MAVLink_param_request_list_message(*to),
                mav.MAVLink_param_ext_request_list_message(*to),
                mav.MAVLink_param_request_read_message(*to, name, self.random.randrange(-2, 99)),
                mav.MAVLink_arm_target_message(*to, 0, 0, 1, [x, y, z], [z, y, x], [x] * 4, y, [z] * 6, x),
                mav.MAVLink_arm_setpoint_message(*to, self.random.getrandbits(60), 0, x, y, [z] * 3, 1.0),
                mav.MAVLink_file_transfer_protocol_message(0, *to, self.random.randbytes(251)),
                mav.MAVLink_timesync_message(self.random.choice([0, 5]), self.random.getrandbits(40)),
                mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
                mav.MAVLink_heartbeat_message(2, 12, 209, 0, 4, 3),
                mav.MAVLink_setup_signing_message(*to, list(bytes(32)), 0),
                mav.MAVLink_ping_message(1, 1, 0, 0),
            ]
        )

    def noise(self) -> bytes:
        return self.random.randbytes(self.random.randrange(1, 300))

    def damaged(self) -> bytes:
        frame = bytearray(self.random.choice(self.recorded) if self.recorded else self.unsigned())
        frame[self.random.randrange(len(frame))] ^= 1 << self.random.randrange(8)
        return bytes(frame)

    def replay(self) -> bytes:
        return self.random.choice(self.recorded) if self.recorded else b""

    def unsigned(self) -> bytes:
        return self.sender().encode(self.message())

    def wrong_key(self) -> bytes:
        signing = Signing(self.random.randbytes(32), self.random.randrange(256))
        return signing.sign(self.unsigned(), SIMULATED_EPOCH_S + self.random.uniform(-1e6, 1e6))

    def random_message(self) -> bytes:
        """Any message of the dialect with any content."""
        cls = mav.mavlink_map[self.random.choice(list(mav.mavlink_map))]
        head = bytes((0xFD, cls.unpacker.size, 0, 0, 1, 255, 190)) + cls.id.to_bytes(3, "little")
        body = head + self.random.randbytes(cls.unpacker.size)
        crc = mav.x25crc(body[1:] + bytes((cls.crc_extra,))).crc
        return body + crc.to_bytes(2, "little")

    def carried(self) -> bytes:
        inner = self.unsigned()
        return self.sender().encode(tunnel(inner, *self.address())) if len(inner) <= 128 else inner

    def next(self) -> bytes:
        return self.random.choice(self.tunnelled_too)()


async def attack(minutes: float, per_step: int) -> None:
    """One signing ground link; every order on it that counts is signed by the one station that may command."""
    async with service_rig(commanders=(255,)) as rig:
        loop = asyncio.get_running_loop()
        signing = Signing(KEY, 7)
        rig.links[1].secure(Signing(KEY), lambda: SIMULATED_EPOCH_S + loop.time())
        rig.ground.codec.seal = lambda frame: signing.sign(frame, SIMULATED_EPOCH_S + loop.time())
        recorded: list[bytes] = []
        attacker = Attacker(1, recorded)
        taken: Counter[Order] = Counter()
        given: Counter[Order] = Counter()
        await asyncio.sleep(0.05)
        before = 0
        steps = round(minutes * 60.0 / STEP_S)
        for step in range(steps):
            if step % 20 == 0:  # a good order once a second
                order = random.Random(step).choice([Order.READY, Order.ABORT, Order.RELEASE])
                frame = rig.ground.codec.encode(
                    mav.MAVLink_command_long_message(1, 192, getattr(mav, f"MAV_CMD_ARM_{order.name}"), 0, *[0.0] * 7)
                )
                given[order] += 1
                rig.ground.send_raw(frame)
                recorded.append(frame)
                del recorded[:-200]
                await asyncio.sleep(0.0)
            for _ in range(per_step):
                rig.ground.send_raw(attacker.next())
            await asyncio.sleep(STEP_S)
            requests, bar = rig.component.take()
            assert bar is None
            for request in requests:
                taken[request.order] += 1
                rig.component.answer(Answer(request.id, Result.ACCEPTED))
            rig.ground.received.clear()
            rig.autopilot.received.clear()
            if step == steps // 4:
                gc.collect()
                tracemalloc.start()
                before = tracemalloc.get_traced_memory()[0]
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
        tracemalloc.stop()
        assert taken == given
        assert grown < 300_000, grown
        check(rig)


def check(rig: ServiceRig) -> None:
    assert rig.settings.config.perch.standoff_m == 0.6
    assert rig.settings._changed == {}
    assert rig.powers == []
    assert rig.component.access.holder == (0, 0)
    assert rig.component.guidance.setpoint is None
    assert [link.counters.handler_errors for link in rig.links] == [0, 0]
    counters = rig.links[1].codec.counters
    assert counters.refused > 100
    assert counters.bad_crc > 100
    assert counters.garbage > 1000


def test_a_minute_of_hostile_traffic_changes_nothing() -> None:
    run_simulated(attack(minutes=1.0, per_step=4))


@pytest.mark.soak
def test_an_hour_of_hostile_traffic_changes_nothing() -> None:
    run_simulated(attack(minutes=60.0, per_step=2))


def test_without_signing_strangers_and_impossible_values_change_nothing() -> None:
    """No key: what counts is who may command, who is meant, and whether the values can be."""

    async def main() -> None:
        async with service_rig(commanders=(77,)) as rig:
            attacker = Attacker(2, [rig.ground.codec.encode(GCS)])
            for _ in range(2000):
                rig.ground.send_raw(attacker.next())
                await asyncio.sleep(0.01)
                requests, bar = rig.component.take()
                # a frame of ours that comes back through the air is no sender, and 1/1 on this link no autopilot
                assert (requests, bar) == ([], None)
                rig.ground.received.clear()
                rig.autopilot.received.clear()
            assert rig.settings._changed == {}
            assert rig.component.guidance.setpoint is None
            assert rig.powers == []
            assert rig.component.access.holder == (0, 0)
            counters = rig.component.commands.counters
            assert counters.forbidden > 10
            assert counters.denied > 10

    run_simulated(main())
