"""Our component behind each autopilot as measured: what passes, at which rate, and every trap on the way."""

import asyncio
import contextlib
import dataclasses
import itertools
import math
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from typing import Any

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated, ticks
from arm_companion.config import Config
from arm_companion.config.parameters import PARAMETERS
from arm_companion.config.schema import LinkConfig
from arm_companion.drivers.autopilot import Autopilot
from arm_companion.drivers.component import Component
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.mirrors import NAMES
from arm_companion.drivers.settings import Settings
from arm_companion.drivers.telemetry import Telemetry
from arm_companion.drivers.timesync import Timesync
from arm_companion.drivers.vehicle_check import VehicleCheck
from arm_companion.mission.facts import Order, Setpoint, StatusReport, TendonState, WrenchReport, WrenchSource
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.tunnel import tunnel
from arm_companion.sim.autopilot import AutopilotStandIn
from arm_companion.sim.autopilot_flavours import FORWARD, LINK_OPTIONS
from arm_companion.transport.memory import MemoryPipe
from tests.conftest import MavlinkPeer
from tests.sim.flight_rig import config as sim_config
from tests.sim.flight_rig import stand
from tests.sim.rigid_body import RigidBody

STATUS = StatusReport("ready", "READY", 3, 40, 0, 0, 0.5, -0.2, (0.01, 0.02, 0.2), 0.6, -0.2)
TENDON = TendonState(0.01, 0.0, 4.5, 0.4, 0.12, 31.0, 11.8, 0, silent=False, age_s=0.01, torque=True)
WRENCH = WrenchReport(
    (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (0.5,) * 3, (0.05,) * 3, WrenchSource.FREE, True, math.nan, 1e-9
)  # fmt: skip
HOLD = Setpoint((0.0, 0.0, -1.0), (0.0,) * 3, (0.0,) * 3, 0.0)
GCS = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3)


@dataclass
class Rig:
    stand_in: AutopilotStandIn
    ground: MavlinkPeer
    link: MavlinkLink
    component: Component
    autopilot: Autopilot
    timesync: Timesync
    check: VehicleCheck
    pipe: MemoryPipe

    def ours(self, name: str) -> list[Any]:
        return [m for m in self.ground.all(name) if (m.get_srcSystem(), m.get_srcComponent()) == (1, 192)]

    def words(self) -> str:
        text = ""
        for message in self.ours("STATUSTEXT"):
            text += message.text + ("" if message.id and len(message.text) == 50 else " | ")
        return text


@contextlib.asynccontextmanager
async def behind(flavour: str, prepare: Callable[[AutopilotStandIn], None]) -> AsyncIterator[Rig]:
    """The component's daemon side, without arm, on the stand-in's companion port; a ground station on the other."""
    stand_in = AutopilotStandIn(sim_config(), flavour, ready_s=1.0)
    prepare(stand_in)
    body = RigidBody()
    companion, ground_pipe = MemoryPipe(), MemoryPipe()
    base = Config()
    config = dataclasses.replace(base, vehicle=dataclasses.replace(base.vehicle, autopilot=flavour))
    clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
    link = MavlinkLink(
        "autopilot", "autopilot", companion.opener(1), config.vehicle, config=LinkConfig("", "autopilot")
    )
    timesync = Timesync(link, clock)
    autopilot = Autopilot(link, config.vehicle, timesync)
    component = Component([link], config.vehicle, clock, settings=Settings(config))
    check = VehicleCheck(link, autopilot, config.vehicle, config.mavlink, component.notify)
    telemetry = Telemetry([link], config.rates, clock)
    ground = MavlinkPeer(255, 190)
    ground.pipe = ground_pipe

    async def cycles() -> None:
        async for tick in ticks(0.01):
            telemetry.publish(tick.now, STATUS, (TENDON,) * 4, WRENCH)
            autopilot.send(HOLD, tick.now)

    async def station() -> None:
        async for _ in ticks(1.0):
            ground.send(GCS)

    await ground.open()
    parts = (
        stand_in.run(companion.opener(0), ground_pipe.opener(0)),
        stand(stand_in, body), link.run(), autopilot.run(), timesync.run(), component.run(), check.run(), cycles(),
        station(),
    )  # fmt: skip
    tasks = [asyncio.create_task(part) for part in parts]
    try:
        await asyncio.sleep(3.5)
        yield Rig(stand_in, ground, link, component, autopilot, timesync, check, companion)
    finally:
        for task in tasks:
            task.cancel()
        ends = await asyncio.gather(*tasks, return_exceptions=True)
    assert all(isinstance(end, asyncio.CancelledError) for end in ends), ends
    assert link.counters.handler_errors == 0


def through(
    body: Callable[[Rig], Coroutine[Any, Any, None]],
    flavour: str = "px4",
    prepare: Callable[[AutopilotStandIn], None] = lambda _: None,
) -> None:
    async def main() -> None:
        async with behind(flavour, prepare) as rig:
            await body(rig)

    run_simulated(main())


BOTH = pytest.mark.parametrize("flavour", ["px4", "ardupilot"])


@BOTH
def test_the_whole_telemetry_arrives_at_its_rates_and_nothing_is_lost(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.received.clear()
        lost = rig.ground.inner.counters.lost
        await asyncio.sleep(10.0)
        counts = [len(rig.ours(n)) for n in ("ARM_REACTION_WRENCH", "ARM_STATUS", "ARM_TENDONS", "HEARTBEAT")]
        assert counts == pytest.approx([200, 100, 100, 10], abs=1)
        assert rig.ground.inner.counters.lost == lost  # of the frames inside TUNNEL not one
        stamps = [m.time_usec for m in rig.ours("ARM_REACTION_WRENCH")]
        assert all(b - a == pytest.approx(50_000, abs=10_001) for a, b in itertools.pairwise(stamps))
        assert rig.stand_in.counters.burst_dropped == 0
        assert rig.stand_in.counters.private_dropped == 0
        assert rig.link.counters.crowded_out == 0

    through(body, flavour)


@BOTH
def test_all_parameters_come_at_the_first_try_while_telemetry_goes_on(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.received.clear()
        rig.ground.send(mav.MAVLink_param_request_list_message(1, 192))
        await asyncio.sleep(2.0)
        values = rig.ours("PARAM_VALUE")
        assert [m.param_index for m in values] == list(range(len(PARAMETERS)))
        assert len(rig.ours("ARM_REACTION_WRENCH")) == pytest.approx(40, abs=1)
        assert rig.stand_in.counters.burst_dropped == 0

    through(body, flavour)


@BOTH
def test_the_mirrors_arrive(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.received.clear()
        await asyncio.sleep(2.5)
        values = {m.name: m.value for m in rig.ours("NAMED_VALUE_FLOAT")}
        assert tuple(values) == NAMES
        assert (values["arm_state"], values["arm_fz"], values["arm_tmax"]) == (3.0, 3.0, 4.5)
        array = rig.ours("DEBUG_FLOAT_ARRAY")[-1]
        assert array.name == "arm"
        assert array.data[4:10] == pytest.approx((1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
        assert len(rig.ours("NAMED_VALUE_FLOAT")) == pytest.approx(2.5 * len(NAMES), abs=len(NAMES))

    through(body, flavour)


@BOTH
def test_commands_come_down_and_targets_come_down_in_tunnel(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        target = mav.MAVLink_arm_target_message(
            1, 192, 0, 0, 1, [3.0, 0.0, -2.0], [0.0, 1.0, 0.0], [math.nan] * 4, 0.02, [math.nan] * 6, math.nan
        )
        setpoint = mav.MAVLink_arm_setpoint_message(1, 192, 0, 0, 0.3, 0.0, [math.nan] * 3, 1.0)
        inner = MavlinkCodec(255, 190)
        rig.ground.send(target)  # directly it is dropped on the way
        await asyncio.sleep(0.1)
        assert rig.component.take()[1] is None
        rig.ground.send(tunnel(inner.encode(target), 1, 192))
        await asyncio.sleep(0.05)
        rig.ground.send(tunnel(inner.encode(setpoint), 1, 192))
        rig.ground.command(mav.MAV_CMD_ARM_READY)
        await asyncio.sleep(0.1)
        requests, bar = rig.component.take()
        assert [r.order for r in requests] == [Order.READY]
        assert bar is not None
        assert rig.component.guidance.setpoint is not None
        assert rig.stand_in.counters.private_dropped == 1

    through(body, flavour)


@BOTH
def test_a_mission_grabs_through_the_autopilot(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        rig.stand_in.mission_item(mav.MAV_CMD_DO_GRIPPER, (192.0, 1.0))
        await asyncio.sleep(0.1)
        assert [r.order for r in rig.component.take()[0]] == ([Order.PERCH] if flavour == "px4" else [])

    through(body, flavour)


@BOTH
def test_the_clocks_are_tied_together_and_again_after_a_reboot(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        def error() -> float:
            loop = asyncio.get_running_loop().time()
            theirs = rig.timesync.autopilot_time(loop)
            assert theirs is not None
            return abs(theirs - rig.stand_in._up_s(loop))

        assert error() <= rig.timesync.error_s < 0.002
        state = rig.autopilot.state(asyncio.get_running_loop().time())
        assert 0.0 < state.attitude_age_s < 0.03
        assert state.clock_error_s == rig.timesync.error_s
        rig.stand_in.reboot()
        await asyncio.sleep(6.0)
        assert error() <= rig.timesync.error_s < 0.002
        assert rig.autopilot.counters.reboots == 1
        assert rig.autopilot.state(asyncio.get_running_loop().time()).attitude_age_s < 0.03

    through(body, flavour)


@BOTH
def test_a_vehicle_that_is_set_up_well_is_not_complained_about(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        await asyncio.sleep(7.0)
        assert rig.check.findings == []
        assert "vehicle:" not in rig.words()

    through(body, flavour)


@pytest.mark.parametrize(
    ("flavour", "name", "value", "words"),
    [
        ("px4", FORWARD, 0, "set MAV_1_FORWARD to 1"),
        ("px4", "COM_OBL_RC_ACT", 3, "set COM_OBL_RC_ACT to 5"),
        ("px4", "COM_OF_LOSS_T", 30.0, "leaves OFFBOARD after 30 s"),
        ("ardupilot", LINK_OPTIONS, 2, "clear bit 1 of MAV2_OPTIONS"),
        ("ardupilot", "GUID_TIMEOUT", 60.0, "set GUID_TIMEOUT to 3"),
    ],
)
def test_what_is_set_up_wrong_is_told_once_with_its_mend_and_again_after_a_reboot(
    flavour: str, name: str, value: float, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    def prepare(stand_in: AutopilotStandIn) -> None:
        stand_in._parameters._values[name] = value

    async def body(rig: Rig) -> None:
        await asyncio.sleep(3.0)
        assert len(rig.check.findings) == 1
        assert words in rig.check.findings[0].text
        await asyncio.sleep(3.0)
        said = [record for record in caplog.records if words in record.getMessage()]
        assert len(said) == 1
        if name not in (FORWARD, LINK_OPTIONS):  # then nobody on the ground hears it either
            assert rig.words().count(words) == 1
        rig.stand_in.reboot()
        await asyncio.sleep(9.0)
        assert len([record for record in caplog.records if words in record.getMessage()]) == 2

    through(body, flavour, prepare)


@BOTH
def test_an_estimator_is_given_the_time_that_it_needs(flavour: str) -> None:
    async def body(rig: Rig) -> None:
        await asyncio.sleep(50.0)  # no position comes for the first 8 or 42 s
        assert "LOCAL_POSITION_NED" not in rig.words()
        assert not rig.autopilot.slow_streams

    through(body, flavour, lambda stand_in: setattr(stand_in, "_ready_s", 41.95))


def test_a_stream_that_stays_slow_is_told() -> None:
    def prepare(stand_in: AutopilotStandIn) -> None:
        stand_in._flavour = dataclasses.replace(stand_in._flavour, least_period_s=0.1)
        for port in stand_in._ports:
            port.streams._flavour = stand_in._flavour

    async def body(rig: Rig) -> None:
        await asyncio.sleep(7.0)
        assert "ATTITUDE_QUATERNION comes at 10 Hz, 100 are asked for" in rig.words()
        assert rig.words().count("ATTITUDE_QUATERNION comes") == 1
        assert rig.autopilot.slow_streams["LOCAL_POSITION_NED"][0] == 100.0

    through(body, "px4", prepare)


@BOTH
def test_before_our_first_heartbeat_the_autopilot_takes_for_itself_what_is_meant_for_us(flavour: str) -> None:
    """The trap that makes us beat at once: an order to arm, sent to 1/192, arms the vehicle."""

    async def main() -> None:
        stand_in = AutopilotStandIn(sim_config(), flavour, ready_s=0.1)
        companion, ground_pipe = MemoryPipe(), MemoryPipe()
        ground = MavlinkPeer(255, 190)
        ground.pipe = ground_pipe
        companion_peer = MavlinkPeer(1, 192)
        companion_peer.pipe = companion
        tasks = [
            asyncio.create_task(stand_in.run(companion.opener(0), ground_pipe.opener(0))),
            asyncio.create_task(stand(stand_in, RigidBody())),
        ]
        await ground.open()
        await companion_peer.open()
        await asyncio.sleep(1.0)
        force = (1.0, 21196.0)
        ground.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, *force)
        await asyncio.sleep(0.1)
        assert stand_in.armed
        assert companion_peer.all("COMMAND_LONG") == []
        ground.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196.0)
        companion_peer.send(mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        await asyncio.sleep(0.1)
        assert not stand_in.armed
        ground.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, *force)
        await asyncio.sleep(0.1)
        assert not stand_in.armed
        assert len(companion_peer.all("COMMAND_LONG")) == 1
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    run_simulated(main())
