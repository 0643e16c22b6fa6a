"""The component's standard services: cancel, grippers, primary control, restart, information, who may ask for what."""

import asyncio
import math
import struct
from typing import Any

import pytest

from arm_companion.drivers.standard_services import Power
from arm_companion.mission.facts import Answer, Notice, Order, Result, Severity
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.mavlink_frames import checksum
from arm_companion.protocol.tunnel import tunnel
from tests.conftest import MavlinkPeer
from tests.unit.component_rig import GCS, ServiceRig, serve

ACCEPTED, DENIED, LATER = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED, mav.MAV_RESULT_TEMPORARILY_REJECTED
UNSUPPORTED, CANCELLED = mav.MAV_RESULT_UNSUPPORTED, mav.MAV_RESULT_CANCELLED
PERCH, GRIPPER, CONTROL = mav.MAV_CMD_ARM_PERCH, mav.MAV_CMD_DO_GRIPPER, mav.MAV_CMD_ARM_CONTROL
POWER = mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
NAN = math.nan


async def soon() -> None:
    await asyncio.sleep(0.05)


def cancel(command: int) -> Any:
    return mav.MAVLink_command_cancel_message(1, 192, command)


# --- cancel ---


def test_a_command_that_waits_is_taken_back() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.command(PERCH)
        rig.ground.send(cancel(PERCH))
        await soon()
        assert rig.component.take() == ([], None)
        assert rig.results() == [(PERCH, CANCELLED)]
        rig.ground.send(cancel(PERCH))  # the answer got lost
        await soon()
        assert rig.results() == [(PERCH, CANCELLED)] * 2
        assert rig.component.commands.counters.cancelled == 1

    serve(body)


def test_a_command_that_runs_ends_by_an_abort_and_is_answered_by_the_mission() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.command(PERCH)
        await soon()
        (perch,), _ = rig.component.take()
        rig.component.answer(Answer(perch.id, Result.IN_PROGRESS, progress=40))
        rig.ground.send(cancel(PERCH))
        await soon()
        (abort,), _ = rig.component.take()
        assert abort.order is Order.ABORT
        rig.component.answer(Answer(perch.id, Result.CANCELLED, "ABORT ordered"))
        rig.component.answer(Answer(abort.id, Result.ACCEPTED))
        await soon()
        assert rig.results() == [(PERCH, mav.MAV_RESULT_IN_PROGRESS), (PERCH, CANCELLED)]

    serve(body)


def test_a_cancel_that_comes_too_late_or_from_a_stranger_changes_nothing() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(cancel(PERCH))
        rig.ground.codec.system_id = 7
        rig.ground.command(PERCH)
        await soon()
        (perch,), _ = rig.component.take()
        rig.ground.codec.system_id = 255
        rig.ground.send(cancel(PERCH))
        await soon()
        assert rig.component.take() == ([], None)
        assert "PERCH goes on: cancel denied: system 255" in rig.words()
        rig.component.answer(Answer(perch.id, Result.ACCEPTED))
        await soon()
        assert rig.results() == [(PERCH, ACCEPTED)]

    serve(body, commanders=(7,))


# --- standard commands ---


@pytest.mark.parametrize("to", [(1, 192), (1, 0)])
@pytest.mark.parametrize(("action", "order"), [(0.0, Order.RELEASE), (1.0, Order.PERCH)])
def test_do_gripper_is_an_order_when_it_names_our_component(to: tuple[int, int], action: float, order: Order) -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.command(GRIPPER, 192.0, action, to=to)
        await soon()
        (request,), _ = rig.component.take()
        assert request.order is order
        assert request.parameters == ((0.0,) if order is Order.PERCH else ())
        rig.component.answer(Answer(request.id, Result.ACCEPTED))
        await soon()
        assert rig.results() == [(GRIPPER, ACCEPTED)]

    serve(body)


def test_the_autopilots_grippers_are_left_to_it() -> None:
    async def body(rig: ServiceRig) -> None:
        for number in (0.0, 1.0, 6.0, NAN):
            rig.ground.command(GRIPPER, number, 0.0, to=(1, 0))
        await soon()
        assert rig.component.take() == ([], None)
        assert rig.results() == []
        rig.ground.command(GRIPPER, 2.0, 0.0)  # to us, but another gripper
        rig.ground.command(GRIPPER, 0.0, 2.0)  # hold: nothing that we could do
        rig.ground.command(GRIPPER, 192.0, NAN)
        await soon()
        assert rig.component.take() == ([], None)
        assert rig.results() == [(GRIPPER, DENIED)] * 3
        assert "param1 = 2 is another gripper; this one is 192" in rig.words()

    serve(body)


def test_a_mission_of_px4_grabs_and_releases() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.autopilot.heartbeat(mav.MAV_AUTOPILOT_PX4, 4 << 16 | 4 << 24)
        await soon()
        rig.autopilot.command(GRIPPER, 192.0, 1.0, to=(1, 0))
        await soon()
        assert [r.order for r in rig.component.take()[0]] == [Order.PERCH]

    serve(body, commanders=(255,))  # the autopilot need not be named


def test_missions_can_be_kept_from_the_arm() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.autopilot.heartbeat(mav.MAV_AUTOPILOT_PX4, 0)
        await soon()
        rig.autopilot.command(GRIPPER, 192.0, 1.0, to=(1, 0))
        await soon()
        assert rig.component.take() == ([], None)
        assert rig.results(rig.autopilot) == [(GRIPPER, DENIED)]

    serve(body, mavlink={"mission_commands": False})


def test_an_actuator_bends_the_arm_where_it_is_mapped() -> None:
    async def body(rig: ServiceRig) -> None:
        command = mav.MAV_CMD_DO_SET_ACTUATOR
        rig.ground.command(command, NAN, -0.5, NAN, NAN, NAN, NAN, 0.0, to=(1, 0))
        await soon()
        (request,), _ = rig.component.take()
        assert request.order is Order.JOG
        assert request.parameters == pytest.approx((1.0, -0.5 * 5.5, 0.0))
        rig.ground.command(command, 0.5, NAN, NAN, NAN, NAN, NAN, 0.0, to=(1, 0))  # another actuator
        rig.ground.command(command, NAN, 1.5, NAN, NAN, NAN, NAN, 0.0)
        await soon()
        assert rig.component.take() == ([], None)
        assert rig.results() == [(command, DENIED)]

    serve(body, mavlink={"actuator": 2})


def test_without_a_mapping_actuators_are_not_ours() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.command(mav.MAV_CMD_DO_SET_ACTUATOR, 0.5, to=(1, 0))
        rig.ground.command(mav.MAV_CMD_DO_SET_ACTUATOR, 0.5)
        await soon()
        assert rig.results() == [(mav.MAV_CMD_DO_SET_ACTUATOR, UNSUPPORTED)]

    serve(body)


@pytest.mark.parametrize("component", [0.0, 192.0])
def test_a_restart_is_carried_out_at_rest_and_answered_first(component: float) -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.command(POWER, 0.0, 0.0, 1.0, component)
        await soon()
        assert rig.results() == [(POWER, ACCEPTED)]
        assert rig.powers == [Power.RESTART]

    serve(body)


def test_a_restart_is_refused_in_flight_at_work_and_for_others() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.component.active = True
        rig.ground.command(POWER, 0.0, 0.0, 2.0, 192.0)
        await soon()
        rig.component.active = False
        rig.autopilot.heartbeat(mav.MAV_AUTOPILOT_PX4, 0, armed=True)
        await soon()
        rig.ground.command(POWER, 0.0, 0.0, 1.0, 192.0)
        await soon()
        rig.autopilot.heartbeat(mav.MAV_AUTOPILOT_PX4, 0, armed=False)
        await soon()
        for parameters in ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 1.0, 0.0), (0.0, 0.0, 3.0, 0.0), (0.0, 0.0, 1.0, 100.0)):
            rig.ground.command(POWER, *parameters)
        await soon()
        assert rig.results() == [(POWER, LATER)] * 2 + [(POWER, DENIED)] * 4
        assert "the arm is at work" in rig.words()
        assert "the vehicle is armed" in rig.words()
        assert rig.powers == []

    serve(body)


# --- primary control ---


def second(rig: ServiceRig) -> MavlinkPeer:
    """Another ground station, behind the autopilot."""
    peer = rig.autopilot
    peer.codec.system_id, peer.codec._sender.srcComponent = 245, 190
    return peer


async def settle(rig: ServiceRig) -> None:
    rig.autopilot.heartbeat(mav.MAV_AUTOPILOT_PX4, 0)
    rig.ground.send(GCS)
    await soon()


def test_two_stations_hand_control_over() -> None:
    async def body(rig: ServiceRig) -> None:
        await settle(rig)
        one, two = rig.ground, second(rig)
        two.send(GCS)
        one.command(CONTROL, 1.0)
        await soon()
        assert rig.component.access.holder == (255, 190)
        two.command(mav.MAV_CMD_ARM_READY)
        two.command(CONTROL, 1.0)
        two.command(CONTROL, 0.0)
        two.command(mav.MAV_CMD_ARM_ABORT)
        two.command(mav.MAV_CMD_ARM_STOW)
        await soon()
        assert [r.order for r in rig.component.take()[0]] == [Order.ABORT, Order.STOW]
        ready = (mav.MAV_CMD_ARM_READY, DENIED)
        assert rig.results(two) == [ready, (CONTROL, DENIED), (CONTROL, DENIED)]
        assert "READY denied: 255/190 has control" in rig.words(two)
        two.command(CONTROL, 2.0)
        await soon()
        assert rig.component.access.holder == (245, 190)
        one.command(mav.MAV_CMD_ARM_READY)
        await soon()
        assert rig.component.take() == ([], None)
        assert "control: 245/190 has taken it" in rig.words(one)
        two.command(CONTROL, 0.0)
        await soon()
        assert rig.component.access.holder == (0, 0)
        one.command(mav.MAV_CMD_ARM_READY)
        await soon()
        assert [r.order for r in rig.component.take()[0]] == [Order.READY]

    serve(body)


def test_a_silent_station_loses_control() -> None:
    async def body(rig: ServiceRig) -> None:
        await settle(rig)
        rig.ground.command(CONTROL, 1.0)
        for _ in range(12):
            rig.ground.send(GCS)
            await asyncio.sleep(1.0)
        assert rig.component.access.holder == (255, 190)
        await asyncio.sleep(6.5)
        assert rig.component.access.holder == (0, 0)
        await asyncio.sleep(1.0)
        assert "control: 255/190 is silent and has lost it" in rig.words(rig.autopilot)
        rig.ground.command(CONTROL, 7.0)
        await soon()
        assert rig.results()[-1] == (CONTROL, DENIED)

    serve(body, mavlink={"control_timeout_s": 5.0})


def test_the_ground_is_as_old_as_its_last_heartbeat() -> None:
    async def body(rig: ServiceRig) -> None:
        assert rig.component.access.ground_age_s == math.inf
        rig.autopilot.heartbeat(mav.MAV_AUTOPILOT_PX4, 0)
        await soon()
        assert rig.component.access.ground_age_s == math.inf  # an autopilot is no ground station
        rig.ground.send(GCS)
        await asyncio.sleep(3.0)
        assert rig.component.access.ground_age_s == pytest.approx(3.0, abs=0.01)

    serve(body)


# --- peers ---


def test_a_peer_tells_where_the_bar_is_but_gives_no_orders() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.codec.system_id = 1
        rig.ground.codec._sender.srcComponent = 197
        rig.ground.send(
            mav.MAVLink_arm_target_message(
                1, 192, 0, 0, 1, [3.0, 0.0, -2.0], [0.0, 1.0, 0.0], [NAN] * 4, 0.02, [NAN] * 6, NAN
            )
        )
        rig.ground.send(mav.MAVLink_arm_setpoint_message(1, 192, 0, 0, 0.5, 0.0, [NAN] * 3, 0.5))
        rig.ground.command(mav.MAV_CMD_ARM_READY)
        rig.ground.command(mav.MAV_CMD_ARM_ABORT)
        await soon()
        requests, bar = rig.component.take()
        assert requests == []
        assert bar is not None
        assert rig.component.guidance.setpoint is None
        assert [result for _, result in rig.results()] == [DENIED, DENIED]
        assert "a peer may not command the arm" in rig.words()

    serve(body, links={"ground": {"role": "peer"}})


# --- information ---


@pytest.mark.parametrize(
    ("id_", "name"),
    [
        (mav.MAVLINK_MSG_ID_COMPONENT_INFORMATION_BASIC, "COMPONENT_INFORMATION_BASIC"),
        (mav.MAVLINK_MSG_ID_COMPONENT_METADATA, "COMPONENT_METADATA"),
    ],
)
def test_what_we_are_is_told_on_request(id_: int, name: str) -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.command(mav.MAV_CMD_REQUEST_MESSAGE, id_)
        await soon()
        (message,) = rig.ground.all(name)
        assert rig.results() == [(mav.MAV_CMD_REQUEST_MESSAGE, ACCEPTED)]
        if name == "COMPONENT_METADATA":
            assert message.uri == "mftp://[;comp=192]/general.json"
        else:
            assert message.vendor_name == "arm_companion"
            assert message.capabilities & mav.MAV_PROTOCOL_CAPABILITY_FTP
            assert message.software_version

    serve(body)


def test_intervals_can_be_asked_for_both_ways() -> None:
    async def body(rig: ServiceRig) -> None:
        for command, parameters in (
            (mav.MAV_CMD_GET_MESSAGE_INTERVAL, (64001.0,)),
            (mav.MAV_CMD_REQUEST_MESSAGE, (244.0, 64001.0)),
            (mav.MAV_CMD_GET_MESSAGE_INTERVAL, (NAN,)),
            (mav.MAV_CMD_GET_MESSAGE_INTERVAL, (70_000.0,)),
        ):
            rig.ground.command(command, *parameters)
        await soon()
        assert [m.interval_us for m in rig.ground.all("MESSAGE_INTERVAL")] == [50_000] * 2
        assert [result for _, result in rig.results()] == [ACCEPTED, ACCEPTED, UNSUPPORTED, UNSUPPORTED]

    serve(body)


def test_a_question_for_the_time_is_answered() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(mav.MAVLink_timesync_message(0, 123_456), mav.MAVLink_timesync_message(9, 123_457))
        await soon()
        (answer,) = rig.ground.all("TIMESYNC")
        assert answer.ts1 == 123_456
        assert answer.tc1 == pytest.approx(asyncio.get_running_loop().time() * 1e9, abs=0.1e9)

    serve(body)


@pytest.mark.parametrize(
    ("target", "answers"), [((1, 1), 0), ((1, 0), 1), ((1, 192), 1), ((2, 192), 0), ((0, 192), 1), ((0, 1), 0)]
)
def test_a_question_for_the_time_of_another_component_is_not_ours_to_answer(
    target: tuple[int, int], answers: int
) -> None:
    """Newer peers put the address behind the fields that pymavlink knows."""

    async def body(rig: ServiceRig) -> None:
        payload = struct.pack("<qqBB", 0, 123_456, *target).rstrip(b"\0")
        frame = bytes((0xFD, len(payload), 0, 0, 0, 255, 190, mav.MAVLINK_MSG_ID_TIMESYNC, 0, 0)) + payload
        rig.ground.send_raw(frame + checksum(frame, 34).to_bytes(2, "little"))
        await soon()
        assert [m.ts1 for m in rig.ground.all("TIMESYNC")] == [123_456] * answers

    serve(body)


# --- the way through TUNNEL ---


def test_what_goes_to_the_autopilot_goes_in_tunnel_and_what_is_direct_does_not() -> None:
    async def body(rig: ServiceRig) -> None:
        await settle(rig)
        for link in rig.links:
            link.send(mav.MAVLink_arm_payload_message(1, 0.2, 0.01, [0.0] * 3, [0.0] * 3, 1))
        rig.component.notify(Notice(Severity.INFO, "plain"))
        await soon()
        assert len(rig.autopilot.all("ARM_PAYLOAD")) == len(rig.autopilot.all("TUNNEL")) == 1
        assert len(rig.ground.all("ARM_PAYLOAD")) == 1
        assert rig.ground.all("TUNNEL") == []
        (carrier,) = rig.autopilot.all("TUNNEL")
        assert (carrier.target_system, carrier.target_component) == (0, 0)
        assert rig.autopilot.codec.counters.lost == rig.autopilot.inner.counters.lost == 0

    serve(body)


@pytest.mark.parametrize(
    ("inner_sender", "to", "taken"),
    [
        ((255, 190), (1, 192), True),
        ((255, 190), (0, 0), True),
        ((254, 190), (1, 192), False),
        ((255, 190), (1, 1), False),
    ],
)
def test_a_target_inside_tunnel_counts_when_its_carrier_is_for_us_and_its_sender_the_carriers(
    inner_sender: tuple[int, int], to: tuple[int, int], taken: bool
) -> None:
    async def body(rig: ServiceRig) -> None:
        target = mav.MAVLink_arm_target_message(
            1, 192, 0, 0, 1, [3.0, 0.0, -2.0], [0.0, 1.0, 0.0], [NAN] * 4, 0.02, [NAN] * 6, NAN
        )
        rig.ground.send(tunnel(MavlinkCodec(*inner_sender).encode(target), *to))
        await soon()
        assert (rig.component.take()[1] is not None) is taken

    serve(body)


def test_only_our_own_messages_come_out_of_a_tunnel() -> None:
    async def body(rig: ServiceRig) -> None:
        order = mav.MAVLink_command_long_message(1, 192, mav.MAV_CMD_ARM_READY, 0, *[0.0] * 7)
        rig.ground.send(tunnel(MavlinkCodec(255, 190).encode(order), 1, 192))
        bad = MavlinkCodec(255, 190).encode(order)
        rig.ground.send(tunnel(bad[:-1] + bytes((bad[-1] ^ 1,)), 1, 192))
        await soon()
        assert rig.component.take() == ([], None)
        assert rig.links[1].counters.tunnelled == 0

    serve(body)
