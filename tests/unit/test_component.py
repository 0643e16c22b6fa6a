"""Our component as another MAVLink system sees it: identity, commands, targets, notices and telemetry."""

import asyncio
import contextlib
import dataclasses
import itertools
import math
import random
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from typing import Any

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config.schema import RatesConfig, VehicleConfig
from arm_companion.drivers import commands
from arm_companion.drivers.component import Component
from arm_companion.drivers.mavlink_link import MavlinkLink, Priority
from arm_companion.drivers.system_status import SystemStatus
from arm_companion.drivers.telemetry import Telemetry
from arm_companion.mission.facts import (
    Answer,
    Bar,
    Notice,
    Order,
    Request,
    Result,
    Severity,
    StatusReport,
    TendonState,
    WrenchReport,
    WrenchSource,
)
from arm_companion.protocol.dialect import mav
from tests.conftest import MavlinkPeer

PX4 = mav.MAV_AUTOPILOT_PX4
NAN = math.nan

STATUS = StatusReport("perch", "REACH", 5, 40, 0, 0, 0.5, -0.2, (0.01, 0.02, 0.2), 0.6, -0.2)
WRENCH = WrenchReport(
    (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (0.5,) * 3, (0.05,) * 3, WrenchSource.ANCHORED, True, 0.02, 1e-9
)  # fmt: skip
TENDON = TendonState(0.01, 0.0, 4.5, 0.4, 0.12, 31.0, 11.8, 0, silent=False, age_s=0.01, torque=True)


@dataclass
class Rig:
    """A component on two links, with an autopilot and a ground station at their far ends."""

    component: Component
    telemetry: Telemetry
    links: list[MavlinkLink]
    autopilot: Any
    ground: Any

    def acks(self) -> list[tuple[int, int]]:
        return [(m.command, m.result) for m in self.ground.all("COMMAND_ACK")]

    def words(self) -> str:
        return " | ".join(m.text for m in self.ground.all("STATUSTEXT"))


@pytest.fixture
def fly(autopilot_peer: Any, ground_peer: Any) -> Callable[..., None]:
    """Run a test body against a rig in simulated time."""

    @contextlib.asynccontextmanager
    async def running(vehicle: VehicleConfig) -> AsyncIterator[Rig]:
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        links = [
            MavlinkLink("autopilot", "autopilot", autopilot_peer.pipe.opener(0), vehicle),
            MavlinkLink("ground", "ground", ground_peer.pipe.opener(0), vehicle),
        ]
        component = Component(links, vehicle, clock)
        telemetry = Telemetry(links, RatesConfig(), clock)
        await autopilot_peer.open()
        await ground_peer.open()
        tasks = [asyncio.create_task(r) for r in (*(link.run() for link in links), component.run())]
        try:
            await asyncio.sleep(0.01)
            yield Rig(component, telemetry, links, autopilot_peer, ground_peer)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        assert [link.counters.handler_errors for link in links] == [0, 0]

    def run(body: Callable[[Rig], Coroutine[Any, Any, None]], **vehicle: Any) -> None:
        async def main() -> None:
            async with running(VehicleConfig(**vehicle)) as rig:
                await body(rig)

        run_simulated(main())

    return run


# --- identity ---


def test_the_first_heartbeat_goes_out_at_once_and_then_one_a_second(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        (first,) = rig.ground.all("HEARTBEAT")[:1]
        assert (first.get_srcSystem(), first.get_srcComponent()) == (1, 192)
        assert (first.type, first.autopilot) == (mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID)
        assert first.system_status == SystemStatus.BOOT
        before = len(rig.ground.all("HEARTBEAT"))
        rig.component.status = SystemStatus.ACTIVE
        await asyncio.sleep(10.0)
        beats = rig.ground.all("HEARTBEAT")
        assert len(beats) - before == 10
        assert beats[-1].system_status == mav.MAV_STATE_ACTIVE
        rig.component.status = SystemStatus.CRITICAL
        await asyncio.sleep(1.0)
        assert rig.ground.all("HEARTBEAT")[-1].system_status == mav.MAV_STATE_CRITICAL

    fly(body)


def test_the_autopilot_hears_nothing_until_we_know_who_we_are(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.component.notify(Notice(Severity.INFO, "hello"))
        await asyncio.sleep(3.0)
        assert rig.autopilot.received == []
        rig.autopilot.codec.system_id = 7
        rig.autopilot.heartbeat(PX4, 0)
        await asyncio.sleep(0.02)
        (beat,) = rig.autopilot.all("HEARTBEAT")
        assert (beat.get_srcSystem(), beat.get_srcComponent()) == (7, 192)
        assert rig.ground.all("HEARTBEAT")[-1].get_srcSystem() == 7

    fly(body)


def test_only_an_autopilots_heartbeat_gives_us_a_system(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.autopilot.codec.system_id = 9
        rig.autopilot.heartbeat(mav.MAV_AUTOPILOT_INVALID, 0)
        await asyncio.sleep(2.0)
        assert {m.get_srcSystem() for m in rig.ground.all("HEARTBEAT")} == {1}

    fly(body)


def test_a_configured_system_id_stays(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.autopilot.heartbeat(PX4, 0)
        await asyncio.sleep(2.0)
        assert {m.get_srcSystem() for m in rig.ground.all("HEARTBEAT")} == {3}

    fly(body, system_id=3)


def test_a_link_that_comes_back_hears_us_at_once(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.pipe.cut()
        await rig.ground.open()
        rig.ground.received.clear()
        await asyncio.sleep(0.21)
        assert rig.ground.all("HEARTBEAT")
        assert rig.links[1].counters.opened == 2

    fly(body)


# --- commands ---


def test_a_command_becomes_a_request_and_its_answers_go_to_whoever_asked(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_ARM_PERCH)
        await asyncio.sleep(0.01)
        (request,), bar = rig.component.take()
        assert (request.order, request.parameters, bar) == (Order.PERCH, (0.0,), None)
        assert rig.component.take() == ([], None)
        rig.component.answer(Answer(request.id, Result.IN_PROGRESS, progress=30))
        rig.component.answer(Answer(request.id, Result.ACCEPTED))
        rig.component.answer(Answer(request.id, Result.ACCEPTED))
        await asyncio.sleep(0.01)
        acks = rig.ground.all("COMMAND_ACK")
        assert [(m.result, m.progress) for m in acks] == [
            (mav.MAV_RESULT_IN_PROGRESS, 30),
            (mav.MAV_RESULT_ACCEPTED, 0),
        ]
        assert {(m.target_system, m.target_component) for m in acks} == {(255, 190)}
        assert rig.autopilot.all("COMMAND_ACK") == []
        assert rig.component.commands.counters.stray_answers == 1

    fly(body)


def test_command_int_means_the_same(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.send(
            mav.MAVLink_command_int_message(1, 192, 0, mav.MAV_CMD_ARM_JOG, 0, 0, 3.0, 0.01, 0.02, -0.01, 0, 0, 0.0)
        )
        await asyncio.sleep(0.01)
        (request,), _ = rig.component.take()
        assert request.order is Order.JOG
        assert request.parameters == pytest.approx((3.0, 0.01, 0.02, -0.01))

    fly(body)


def test_a_reach_carries_its_point(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_ARM_REACH, 1.0, 3.0, -2.0, -1.5)
        await asyncio.sleep(0.01)
        (request,), _ = rig.component.take()
        assert (request.order, request.parameters) == (Order.REACH, (1.0, 3.0, -2.0, -1.5))

    fly(body)


def test_a_retry_while_running_does_nothing_twice(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        for confirmation in (0, 1):
            rig.ground.command(mav.MAV_CMD_ARM_PERCH, confirmation=confirmation)
        await asyncio.sleep(0.01)
        (request,), _ = rig.component.take()
        rig.component.answer(Answer(request.id, Result.IN_PROGRESS, progress=55))
        rig.ground.command(mav.MAV_CMD_ARM_PERCH, confirmation=2)
        await asyncio.sleep(0.01)
        assert rig.component.take() == ([], None)
        assert [m.progress for m in rig.ground.all("COMMAND_ACK")] == [255, 55, 55]
        assert rig.component.commands.counters.repeated == 2

    fly(body)


def test_each_link_on_which_a_command_came_gets_its_outcome(fly: Callable[..., None]) -> None:
    """Two stations with the same ids, or one with two ways to us: which of them listens nobody knows."""

    async def body(rig: Rig) -> None:
        rig.autopilot.heartbeat(PX4, 0)
        await asyncio.sleep(0.01)
        behind = MavlinkPeer(255, 190)
        behind.transport = rig.autopilot.transport
        rig.ground.command(mav.MAV_CMD_ARM_PERCH)
        behind.command(mav.MAV_CMD_ARM_PERCH)
        await asyncio.sleep(0.01)
        (request,), _ = rig.component.take()
        rig.component.answer(Answer(request.id, Result.FAILED, "no contact"))
        await asyncio.sleep(0.2)
        for peer in (rig.ground, rig.autopilot):
            assert [m.result for m in peer.all("COMMAND_ACK")][-1] == mav.MAV_RESULT_FAILED
            assert "PERCH failed: no contact" in "".join(m.text for m in peer.all("STATUSTEXT"))

    fly(body)


def test_a_final_answer_that_got_lost_is_repeated_but_a_new_command_is_new(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_ARM_READY)
        await asyncio.sleep(0.01)
        (request,), _ = rig.component.take()
        rig.component.answer(Answer(request.id, Result.FAILED, "servo 2 is silent"))
        rig.ground.command(mav.MAV_CMD_ARM_READY, confirmation=1)
        await asyncio.sleep(0.01)
        assert rig.component.take() == ([], None)
        assert rig.acks() == [(mav.MAV_CMD_ARM_READY, mav.MAV_RESULT_FAILED)] * 2
        assert "READY failed: servo 2 is silent" in rig.words()
        rig.ground.command(mav.MAV_CMD_ARM_READY)
        await asyncio.sleep(0.01)
        (again,), _ = rig.component.take()
        assert again.id != request.id
        rig.component.answer(Answer(again.id, Result.ACCEPTED))
        await asyncio.sleep(4.0)
        rig.ground.command(mav.MAV_CMD_ARM_READY, confirmation=1)  # far too late to be a retry
        await asyncio.sleep(0.01)
        assert len(rig.component.take()[0]) == 1

    fly(body)


@pytest.mark.parametrize(
    ("command", "parameters", "reason"),
    [
        ("PERCH", (NAN,), "param1 (kind) is not a number"),
        ("PERCH", (math.inf,), "param1 (kind) is not a number"),
        ("PERCH", (0.5,), "not a whole number"),
        ("PERCH", (7.0,), "outside 0 to 1"),
        ("PERCH", (2.0,), "outside 0 to 1"),
        ("JOG", (0.0,), "outside 1 to 3"),
        ("JOG", (1.0, NAN, 0.0), "param2 (theta) is not a number"),
        ("JOG", (1.0, 13.0, 0.0), "param2 (theta) = 13"),
        ("JOG", (1.0, 0.5, -7.0), "param3 (delta)"),
        ("JOG", (2.0, 0.0, 0.0, 20.0), "z"),
        ("JOG", (3.0, 0.0, 0.0, NAN), "param4 (z) is not a number"),
        ("JOG", (3.0, 2.0, 0.0, 0.0), "param2 (x) = 2 is outside -1 to 1"),
        ("REACH", (2.0, 0.0, 0.0, 0.0), "param1 (kind) = 2 is outside 0 to 1"),
        ("REACH", (0.0, 0.0, NAN, 0.0), "param3 (east) is not a number"),
        ("REACH", (0.0, 0.0, 0.0, -2e4), "param4 (down) = -20000"),
    ],
)
def test_a_bad_parameter_is_denied_with_the_reason(
    fly: Callable[..., None], command: str, parameters: tuple[float, ...], reason: str
) -> None:
    id_ = getattr(mav, f"MAV_CMD_ARM_{command}")

    async def body(rig: Rig) -> None:
        rig.ground.command(id_, *parameters)
        await asyncio.sleep(0.01)
        assert rig.component.take() == ([], None)
        assert rig.acks() == [(id_, mav.MAV_RESULT_DENIED)]
        assert reason in rig.words().replace(" | ", "")

    fly(body)


@pytest.mark.parametrize("command", ["STOW", "ABORT"])
def test_the_ways_to_safety_are_taken_whatever_comes_with_them(fly: Callable[..., None], command: str) -> None:
    async def body(rig: Rig) -> None:
        for i in range(40):  # a crowd of others first
            rig.ground.command(mav.MAV_CMD_ARM_JOG, 1.0, 0.01 * i, 0.0)
        rig.ground.command(getattr(mav, f"MAV_CMD_ARM_{command}"), *[NAN] * 7)
        await asyncio.sleep(0.01)
        requests, _ = rig.component.take()
        assert requests[-1].order is Order[command]
        assert requests[-1].parameters == ()
        assert len(requests) < 40
        assert (mav.MAV_CMD_ARM_JOG, mav.MAV_RESULT_TEMPORARILY_REJECTED) in rig.acks()

    fly(body)


@pytest.mark.parametrize("to", [(2, 192), (1, 1), (1, 191), (0, 192), (0, 0), (255, 190)])
def test_what_is_addressed_to_others_is_ignored_and_counted(fly: Callable[..., None], to: tuple[int, int]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_ARM_PERCH, to=to)
        await asyncio.sleep(0.01)
        assert rig.component.take() == ([], None)
        assert rig.acks() == []
        assert rig.component.counters.not_for_us == 1

    fly(body)


def test_a_command_to_everybody_is_ours_only_if_nobody_else_knows_it(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_ARM_ABORT, to=(1, 0))
        rig.ground.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, to=(1, 0))
        await asyncio.sleep(0.01)
        assert [r.order for r in rig.component.take()[0]] == [Order.ABORT]
        assert rig.acks() == []

    fly(body)


def test_who_may_not_command_is_denied_and_who_may_is_not(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        rig.ground.send(target())
        rig.ground.codec.system_id = 245
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        await asyncio.sleep(0.01)
        assert len(rig.component.take()[0]) == 1
        assert rig.component.take()[1] is None
        (ack,) = rig.ground.all("COMMAND_ACK")
        assert (ack.result, ack.target_system) == (mav.MAV_RESULT_DENIED, 255)
        assert "ABORT denied: system 255 may not command" in rig.words()
        assert rig.component.commands.counters.forbidden == 1
        assert rig.component.guidance.counters.bad_targets == 1

    fly(body, commanders=(245,))


def test_unknown_commands_and_those_to_come_are_unsupported(fly: Callable[..., None]) -> None:
    unknown = [mav.MAV_CMD_COMPONENT_ARM_DISARM, 65_000]
    unknown += [c for c in range(64000, 64010) if commands.order_of(c) is None]

    async def body(rig: Rig) -> None:
        for command in unknown:
            rig.ground.command(command, 1.0)
        await asyncio.sleep(0.01)
        assert rig.acks() == [(c, mav.MAV_RESULT_UNSUPPORTED) for c in unknown]
        assert rig.component.take() == ([], None)

    fly(body)


def test_every_order_has_a_command() -> None:
    assert {commands.order_of(c) for c in range(64000, 64012)} >= set(Order)


def test_requests_that_are_never_answered_do_not_pile_up(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        last: Request | None = None
        for i in range(300):
            rig.ground.command(mav.MAV_CMD_ARM_JOG, 1.0, 0.001 * i, 0.0)
            await asyncio.sleep(0.01)
            (last,), _ = rig.component.take()
        assert len(rig.component.commands._asks) <= 64
        assert last is not None
        rig.component.answer(Answer(last.id, Result.ACCEPTED))
        await asyncio.sleep(0.01)
        assert rig.acks() == [(mav.MAV_CMD_ARM_JOG, mav.MAV_RESULT_ACCEPTED)]

    fly(body)


# --- messages on demand ---


def publish(rig: Rig, **changes: Any) -> None:
    tendons = changes.pop("tendons", (TENDON,) * 4)
    rig.telemetry.publish(asyncio.get_running_loop().time(), STATUS, tendons, WRENCH, **changes)


async def cycles(rig: Rig, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        publish(rig)
        await asyncio.sleep(0.01)


def test_telemetry_flows_at_the_configured_rates(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        await cycles(rig, 5.0)
        counts = [len(rig.ground.all(n)) for n in ("ARM_STATUS", "ARM_TENDONS", "ARM_REACTION_WRENCH")]
        assert counts == [50, 50, 100]

    fly(body)


def test_intervals_are_changed_for_one_link_alone(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.autopilot.heartbeat(PX4, 0)
        rig.ground.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 64001, 20_000)
        rig.ground.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 64002, -1)
        await asyncio.sleep(0.1)
        rig.ground.command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL, 64001)
        await cycles(rig, 4.0)
        assert len(rig.ground.all("ARM_REACTION_WRENCH")) == 200
        assert rig.ground.all("ARM_TENDONS") == []
        assert len(rig.autopilot.all("ARM_REACTION_WRENCH")) == 80
        (interval,) = rig.ground.all("MESSAGE_INTERVAL")
        assert (interval.message_id, interval.interval_us) == (64001, 20_000)
        rig.ground.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 64002, 0)
        await cycles(rig, 1.0)
        assert len(rig.ground.all("ARM_TENDONS")) == 10

    fly(body)


@pytest.mark.parametrize(
    ("id_", "interval"), [(64001, 100), (64001, NAN), (NAN, 10_000), (30, 10_000), (0, 10_000), (64001.5, 10_000)]
)
def test_intervals_that_cannot_be_are_denied(fly: Callable[..., None], id_: float, interval: float) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, id_, interval)
        await asyncio.sleep(0.01)
        await cycles(rig, 1.0)
        assert rig.acks() == [(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAV_RESULT_DENIED)]
        assert len(rig.ground.all("ARM_REACTION_WRENCH")) == 20

    fly(body)


def test_a_message_is_sent_on_request(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 64000, -1)
        await asyncio.sleep(0.01)
        await cycles(rig, 0.5)
        assert rig.ground.all("ARM_STATUS") == []
        rig.ground.command(mav.MAV_CMD_REQUEST_MESSAGE, 64000)
        await cycles(rig, 0.5)
        assert len(rig.ground.all("ARM_STATUS")) == 1
        beats = len(rig.ground.all("HEARTBEAT"))
        rig.ground.command(mav.MAV_CMD_REQUEST_MESSAGE, 0)
        rig.ground.command(mav.MAV_CMD_REQUEST_MESSAGE, 148)
        rig.ground.command(mav.MAV_CMD_REQUEST_MESSAGE, NAN)
        await asyncio.sleep(0.005)
        assert len(rig.ground.all("HEARTBEAT")) == beats + 1
        assert [result for _, result in rig.acks()[-3:]] == [
            mav.MAV_RESULT_ACCEPTED,
            mav.MAV_RESULT_UNSUPPORTED,
            mav.MAV_RESULT_UNSUPPORTED,
        ]

    fly(body)


def test_status_and_wrench_carry_what_the_mission_reports(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        hot = dataclasses.replace(TENDON, error_bits=0x24, silent=True, torque=False)
        publish(rig, tendons=(TENDON, hot))
        at = asyncio.get_running_loop().time()
        await asyncio.sleep(0.01)
        (status,), (wrench,) = rig.ground.all("ARM_STATUS"), rig.ground.all("ARM_REACTION_WRENCH")
        assert status.time_usec == wrench.time_usec == round((SIMULATED_EPOCH_S + at) * 1e6)
        assert (status.behaviour, status.state, status.state_name) == (mav.ARM_BEHAVIOUR_PERCH, 5, "REACH")
        assert status.tip_position == pytest.approx((0.01, 0.02, 0.2))
        assert (status.theta, status.delta, status.progress) == pytest.approx((0.5, -0.2, 40))
        assert status.flags == mav.ARM_FLAG_CONTACT | mav.ARM_FLAG_ANCHORED
        assert status.errors == (
            mav.ARM_ERROR_SERVO_SILENT | mav.ARM_ERROR_SERVO_FAULT | mav.ARM_ERROR_OVERHEAT | mav.ARM_ERROR_OVERLOAD
        )
        assert (*wrench.force, *wrench.torque) == pytest.approx((1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
        assert (wrench.source, wrench.validity) == (2, 3)
        assert wrench.taut_margin == pytest.approx(0.02)

    fly(body)


def test_five_tendons_need_two_messages_and_unknown_numbers_say_so(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        blind = dataclasses.replace(TENDON, temperature=NAN, voltage=NAN, tension=NAN, silent=True)
        publish(rig, tendons=(TENDON, TENDON, TENDON, blind, TENDON), goals=(0.1, 0.2, 0.3, 0.4, 0.5))
        await asyncio.sleep(0.01)
        first, second = rig.ground.all("ARM_TENDONS")
        assert (first.first, first.count, second.first, second.count) == (0, 4, 4, 1)
        assert (first.silent, first.torque) == (0b1000, 0b1111)
        assert first.goal == pytest.approx((0.1, 0.2, 0.3, 0.4))
        assert (first.load[0], first.temperature[0], first.voltage[0]) == (120, 3100, 11_800)
        assert (first.temperature[3], first.voltage[3]) == (32_767, 65_535)
        assert math.isnan(first.tension[3])
        assert math.isnan(second.displacement[1])

    fly(body)


# --- targets, notices, ping ---


def target(**changes: Any) -> Any:
    values: dict[str, Any] = {
        "target_system": 1, "target_component": 192, "time_usec": 0, "kind": mav.ARM_TARGET_KIND_BAR,
        "frame": mav.MAV_FRAME_LOCAL_NED, "position": [3.0, 1.0, -2.0], "axis": [0.0, 2.0, 0.0], "q": [NAN] * 4,
        "radius": 0.02, "position_covariance": [NAN] * 6, "direction_sigma": NAN,
    }  # fmt: skip
    return mav.MAVLink_arm_target_message(**{**values, **changes})


def test_the_newest_target_is_taken_with_a_unit_axis(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.send(target(position=[9.0, 9.0, 9.0]), target())
        await asyncio.sleep(0.01)
        _, bar = rig.component.take()
        assert isinstance(bar, Bar)
        assert (bar.point_w, bar.axis_w) == ((3.0, 1.0, -2.0), (0.0, 1.0, 0.0))
        assert bar.radius == pytest.approx(0.02)
        assert rig.component.take() == ([], None)

    fly(body)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"kind": 7}, "kind 7"),
        ({"frame": mav.MAV_FRAME_BODY_FRD}, "MAV_FRAME_LOCAL_NED"),
        ({"position": [NAN, 0.0, 0.0]}, "position"),
        ({"position": [1e6, 0.0, 0.0]}, "position"),
        ({"axis": [0.0, 0.0, 0.0]}, "axis"),
        ({"axis": [math.inf, 0.0, 0.0]}, "axis"),
        ({"radius": 0.0}, "radius"),
        ({"radius": NAN}, "radius"),
        ({"radius": 3.0}, "radius"),
    ],
)
def test_an_impossible_target_is_refused_with_the_reason(
    fly: Callable[..., None], changes: dict[str, Any], reason: str
) -> None:
    async def body(rig: Rig) -> None:
        for _ in range(10):
            rig.ground.send(target(**changes))
        await asyncio.sleep(0.01)
        assert rig.component.take() == ([], None)
        assert rig.component.guidance.counters.bad_targets == 10
        words = rig.words()
        assert reason in words.replace(" | ", "")
        assert words.count("target refused") == 1  # a stream of targets is not a stream of complaints

    fly(body)


@pytest.mark.parametrize("length", [1, 49, 50, 51, 99, 100, 149, 150, 240])
def test_a_notice_reaches_people_whole(fly: Callable[..., None], length: int) -> None:
    text = "".join(chr(ord("a") + i % 26) for i in range(length))

    async def body(rig: Rig) -> None:
        rig.component.notify(Notice(Severity.ERROR, text))
        await asyncio.sleep(0.01)
        chunks = rig.ground.all("STATUSTEXT")
        assert {m.severity for m in chunks} == {mav.MAV_SEVERITY_ERROR}
        assert "".join(m.text for m in chunks) == text
        if length > 50:
            assert len({m.id for m in chunks}) == 1
            assert chunks[0].id > 0
            assert [m.chunk_seq for m in chunks] == list(range(len(chunks)))
            assert len(chunks[-1].text) < 50  # which tells the receiver that it is complete
        else:
            assert [m.id for m in chunks] == [0]

    fly(body)


def test_a_ping_is_answered_once(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.ground.send(mav.MAVLink_ping_message(123, 4, 0, 0), mav.MAVLink_ping_message(124, 5, 1, 192))
        await asyncio.sleep(0.01)
        (pong,) = rig.ground.all("PING")
        assert (pong.time_usec, pong.seq, pong.target_system, pong.target_component) == (123, 4, 255, 190)

    fly(body)


# --- the link ---


def test_bulk_to_px4_is_paced_and_setpoints_are_not(fly: Callable[..., None]) -> None:
    arrivals: list[float] = []  # of each frame, however they are joined on the way

    async def body(rig: Rig) -> None:
        rig.autopilot.heartbeat(PX4, 0)
        await asyncio.sleep(0.1)
        loop = asyncio.get_running_loop()
        receive = rig.autopilot.transport.receiver

        def note(data: bytes) -> None:
            before = len(rig.autopilot.received)
            receive(data)
            arrivals.extend([loop.time()] * (len(rig.autopilot.received) - before))

        rig.autopilot.transport.receiver = note
        start = loop.time()
        for _ in range(5):
            rig.component.notify(Notice(Severity.INFO, "x" * 120))
        rig.links[0].send(mav.MAVLink_ping_message(1, 1, 1, 1), Priority.NOW)
        await asyncio.sleep(0.3)
        at = [t - start for t in arrivals]
        assert len(at) == 16
        assert at[1] < 0.001  # the urgent one, right behind the first
        assert at[2] >= 0.005
        assert all(b - a >= 0.005 - 1e-9 for a, b in itertools.pairwise(at[2:]))

    fly(body)


def test_a_paced_queue_drops_its_oldest(fly: Callable[..., None]) -> None:
    async def body(rig: Rig) -> None:
        rig.autopilot.heartbeat(PX4, 0)
        await asyncio.sleep(0.1)
        for i in range(200):
            rig.links[0].send(mav.MAVLink_ping_message(i, i, 1, 1))
        await asyncio.sleep(1.0)
        got = [m.seq for m in rig.autopilot.all("PING")]
        assert got == [0, *range(200 - 64, 200)]
        assert rig.links[0].counters.crowded_out == 200 - 65

    fly(body)


def test_one_readers_bug_silences_nobody(fly: Callable[..., None], caplog: pytest.LogCaptureFixture) -> None:
    def broken(*_: Any) -> None:
        raise ValueError("a bug")

    async def body(rig: Rig) -> None:
        rig.links[1]._handlers[mav.MAVLINK_MSG_ID_COMMAND_LONG].insert(0, broken)
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        await asyncio.sleep(0.01)
        assert [r.order for r in rig.component.take()[0]] == [Order.ABORT]
        assert rig.links[1].counters.handler_errors == 1
        rig.links[1].counters.handler_errors = 0

    fly(body)
    assert "a bug" in caplog.text


def test_noise_on_a_link_is_survived_and_the_next_command_works(fly: Callable[..., None]) -> None:
    noise = random.Random(5)

    async def body(rig: Rig) -> None:
        for _ in range(300):
            rig.ground.send_raw(noise.randbytes(noise.randrange(1, 300)))
            await asyncio.sleep(0.001)
        rig.ground.send_raw(b"\xfd\xff\x00")  # the start of a long frame that never comes
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        await asyncio.sleep(0.1)
        assert [r.order for r in rig.component.take()[0]] == [Order.ABORT]
        counters = rig.links[1].codec.counters
        assert counters.garbage > 10_000
        assert counters.decoded == 1

    fly(body)
