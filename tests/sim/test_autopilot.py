"""The autopilot stand-in over in-memory links in simulated time: it behaves, and misbehaves, as measured."""

import asyncio
import math
import random
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest

from arm_companion.clock import run_simulated
from arm_companion.protocol.dialect import mav
from arm_companion.sim.autopilot import AutopilotStandIn
from arm_companion.sim.autopilot_flavours import Mode, px4_mode
from arm_companion.sim.operator_link import OperatorLink
from arm_companion.transport.memory import MemoryPipe
from tests.sim.flight_rig import Rig, config, rig, setpoint, stand

ARM, TAKEOFF, LAND = mav.MAV_CMD_COMPONENT_ARM_DISARM, mav.MAV_CMD_NAV_TAKEOFF, mav.MAV_CMD_NAV_LAND
ACCEPTED, DENIED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED
REJECTED, FAILED = mav.MAV_RESULT_TEMPORARILY_REJECTED, mav.MAV_RESULT_FAILED
INTERVAL = mav.MAV_CMD_SET_MESSAGE_INTERVAL
POSITION_ONLY = 0b000_111_111_000
DAEMON = (1, 192)


def scenario(test: Callable[[Rig], Awaitable[None]], flavour: str = "px4", **options: Any) -> None:
    """Run `test` on a fresh rig in simulated time."""

    async def main() -> None:
        async with rig(flavour, **options) as fresh:
            await fresh.operator.wait_for(lambda o: o.latest("HEARTBEAT") is not None, 5.0)
            await test(fresh)

    run_simulated(main())


def tap(pipe: MemoryPipe) -> list[Any]:
    """Every message that passes a pipe from now on, in either direction."""
    seen: list[Any] = []
    codec = mav.MAVLink(None)

    def watch(data: bytes) -> bytes:
        seen.extend(codec.parse_buffer(data) or ())
        return data

    pipe.fault = watch
    return seen


def tunnel(number: int, target: tuple[int, int] = (0, 0)) -> Any:
    return mav.MAVLink_tunnel_message(*target, 40_000, 1, [number % 256] + [0] * 127)


# Arming, take-off, landing --------------------


def test_arming_waits_for_the_estimator_and_says_why() -> None:
    async def test(r: Rig) -> None:
        assert await r.operator.command(ARM, (1.0,)) == REJECTED
        assert r.operator.texts[-1].text == "Arming denied: estimator not ready"
        assert r.operator.latest("LOCAL_POSITION_NED") is None
        await asyncio.sleep(8.3)
        assert r.operator.latest("LOCAL_POSITION_NED") is not None
        assert await r.operator.command(ARM, (1.0,)) == ACCEPTED
        assert r.autopilot.armed
        assert await r.operator.command(ARM, (float("nan"),)) == DENIED
        assert await r.operator.command(ARM, (0.0,)) == ACCEPTED
        assert not r.autopilot.armed

    scenario(test, ready_s=None, world=stand)


def test_armed_without_a_take_off_it_disarms_after_ten_seconds() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(1.5)
        assert await r.operator.command(ARM, (1.0,)) == ACCEPTED
        await asyncio.sleep(9.5)
        assert r.autopilot.armed
        await asyncio.sleep(1.0)
        assert not r.autopilot.armed
        assert r.body.position[2] > -0.05

    scenario(test, world=stand)


def test_take_off_climbs_to_the_configured_height_and_landing_disarms() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        assert r.body.position[2] == pytest.approx(-1.7, abs=0.12)
        assert r.autopilot.mode is Mode.HOLD
        assert r.heartbeat().custom_mode == px4_mode(4, 3)
        assert r.operator.latest("EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_IN_AIR
        assert await r.operator.command(ARM, (0.0,)) == REJECTED  # not in the air
        assert await r.operator.command(LAND) == ACCEPTED
        await asyncio.sleep(2.0)
        assert r.operator.latest("EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_LANDING
        await r.operator.wait_for(lambda o: not o.latest("HEARTBEAT").base_mode & 128, 15.0)
        assert abs(r.body.position[2]) < 0.02
        assert r.operator.latest("EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_ON_GROUND
        await r.take_off()  # and again
        assert r.body.position[2] == pytest.approx(-1.7, abs=0.12)

    scenario(test, takeoff_height_m=1.7)


def test_take_off_altitude_is_above_sea_level_on_px4() -> None:
    async def test(r: Rig) -> None:
        await r.operator.wait_for(lambda o: o.latest("HOME_POSITION") is not None, 10.0)
        home = r.operator.latest("HOME_POSITION").altitude / 1e3
        parameters = (*[float("nan")] * 6, home + 3.0)
        assert await r.operator.command(TAKEOFF, parameters) == ACCEPTED
        assert await r.operator.command(ARM, (1.0,)) == ACCEPTED
        await asyncio.sleep(9.0)
        assert r.body.position[2] == pytest.approx(-3.0, abs=0.1)
        above = r.operator.latest("GLOBAL_POSITION_INT").relative_alt / 1e3
        assert above == pytest.approx(3.0, abs=0.1)

    scenario(test)


def test_an_altitude_over_home_given_to_px4_lies_far_below_and_is_not_flown_to() -> None:
    async def test(r: Rig) -> None:
        await r.operator.wait_for(lambda o: o.latest("HOME_POSITION") is not None, 10.0)
        await r.operator.command(TAKEOFF, (*[float("nan")] * 6, 2.2))
        assert await r.operator.command(ARM, (1.0,)) == ACCEPTED
        await asyncio.sleep(5.0)
        assert abs(r.body.position[2]) < 0.1
        assert "Already higher than takeoff altitude" in [text.text for text in r.operator.texts]

    scenario(test)


def test_return_flies_home_and_lands_there() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        r.body.position = r.body.position + np.array([2.0, 1.0, 0.0])
        assert await r.operator.command(mav.MAV_CMD_NAV_RETURN_TO_LAUNCH) == ACCEPTED
        await r.operator.wait_for(lambda o: not o.latest("HEARTBEAT").base_mode & 128, 30.0)
        assert math.hypot(*r.body.position[:2]) < 0.35
        assert abs(r.body.position[2]) < 0.02

    scenario(test)


def test_disarming_by_force_drops_the_vehicle() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        assert await r.operator.command(ARM, (0.0, 21196.0)) == ACCEPTED
        await asyncio.sleep(1.5)
        assert r.body.position[2] > -0.1

    scenario(test)


# OFFBOARD --------------------


def test_offboard_needs_a_stream_and_the_first_of_its_two_acks_lies() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        seen = tap(r.pipes[1])
        assert await r.mode(6) == ACCEPTED
        await asyncio.sleep(0.1)
        acks = [m.result for m in seen if m.get_type() == "COMMAND_ACK"]
        assert acks == [ACCEPTED, REJECTED]
        assert r.autopilot.mode is Mode.HOLD
        await r.stream(setpoint(), 3.0, hz=1.8)  # too slow
        await r.mode(6)
        await asyncio.sleep(0.1)
        assert r.autopilot.mode is Mode.HOLD
        await r.stream(setpoint(), 0.8)  # too short
        await r.mode(6)
        assert r.autopilot.mode is Mode.HOLD
        await r.stream(setpoint(), 0.3)
        await r.mode(6)
        assert r.autopilot.mode is Mode.EXTERNAL

    scenario(test)


def test_offboard_goes_where_the_setpoint_says() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        goal = setpoint(1.0, -0.5, -2.5, yaw=0.7)
        await r.go_external(goal)
        await r.stream(goal, 8.0)
        assert r.heartbeat().custom_mode == px4_mode(6)
        assert r.body.position == pytest.approx([1.0, -0.5, -2.5], abs=0.05)
        assert r.autopilot.estimate.yaw == pytest.approx(0.7, abs=0.03)
        target = r.companion.latest("POSITION_TARGET_LOCAL_NED")
        assert (target.x, target.y, target.z) == pytest.approx((1.0, -0.5, -2.5))

    scenario(test)


def test_a_lost_stream_is_a_failsafe_after_a_second_and_resumes_by_itself() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        await r.go_external(setpoint())
        assert r.autopilot.mode is Mode.EXTERNAL
        lost_at = r.now
        await r.companion.wait_for(lambda _: r.autopilot.mode is not Mode.EXTERNAL, 3.0)
        assert 0.9 < r.now - lost_at < 1.1
        await asyncio.sleep(1.2)
        assert r.autopilot.mode is Mode.HOLD
        assert r.heartbeat().system_status == mav.MAV_STATE_CRITICAL
        r.companion.send(setpoint())
        await asyncio.sleep(0.02)
        assert r.autopilot.mode is Mode.EXTERNAL
        await r.stream(setpoint(), 1.5)
        assert r.heartbeat().system_status == mav.MAV_STATE_ACTIVE

    scenario(test)


@pytest.mark.parametrize(("action", "mode"), [(3, Mode.RETURN), (4, Mode.LAND)])
def test_the_parameter_decides_what_a_lost_stream_means(action: int, mode: Mode) -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        value = mav.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", float_of_int(action), mav.MAV_PARAM_TYPE_INT32)
        r.operator.send(value)
        await r.go_external(setpoint())
        await asyncio.sleep(1.2)
        assert r.autopilot.mode is mode

    scenario(test)


def test_the_pilot_always_wins() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        await r.go_external(setpoint())
        r.autopilot.take_over("POSCTL")
        where = r.body.position.copy()
        await r.stream(setpoint(x=5.0), 3.0)
        assert r.autopilot.mode is Mode.POSITION
        assert r.heartbeat().custom_mode == px4_mode(3)
        assert r.body.position == pytest.approx(where, abs=0.1)
        with pytest.raises(ValueError, match="LOITER"):
            r.autopilot.take_over("GUIDED")

    scenario(test)


def test_an_emergency_sinks_whatever_is_commanded() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        await r.go_external(setpoint())
        r.autopilot.fail()
        await r.stream(setpoint(), 1.5)
        assert r.heartbeat().system_status == mav.MAV_STATE_EMERGENCY
        await r.mode(4, 3)
        assert r.autopilot.mode is Mode.LAND
        await r.operator.wait_for(lambda o: not o.latest("HEARTBEAT").base_mode & 128, 15.0)
        assert r.heartbeat().system_status == mav.MAV_STATE_STANDBY

    scenario(test)


NAN = float("nan")


@pytest.mark.parametrize(
    "bad",
    [
        setpoint(frame=mav.MAV_FRAME_BODY_FRD),
        setpoint(frame=mav.MAV_FRAME_LOCAL_OFFSET_NED),
        setpoint(frame=mav.MAV_FRAME_BODY_NED),  # a position in body axes
        setpoint(x=NAN),
        setpoint(vz=math.inf),
        setpoint(afy=NAN),
        setpoint(yaw=NAN),
        setpoint(mask=0b111_111_111),  # nothing commanded
        setpoint(mask=mav.POSITION_TARGET_TYPEMASK_FORCE_SET),
    ],
)
def test_a_setpoint_that_cannot_be_flown_is_no_stream(bad: Any) -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(1.0)
        await r.go_external(bad)
        assert r.autopilot.mode is Mode.HOLD
        assert await r.go_external(setpoint()) == ACCEPTED
        assert r.autopilot.mode is Mode.EXTERNAL

    scenario(test, world=stand)


def test_masked_fields_may_be_nan_and_body_axes_turn_with_the_nose() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        east = setpoint(yaw=math.pi / 2)
        await r.go_external(east)
        await r.stream(east, 4.0)
        start = r.body.position.copy()
        forward = setpoint(
            NAN, NAN, NAN, yaw=NAN, mask=0b111 | mav.POSITION_TARGET_TYPEMASK_YAW_IGNORE, frame=8, vx=0.5
        )
        await r.stream(forward, 4.0)
        moved = r.body.position - start
        assert moved[1] > 1.0
        assert abs(moved[0]) < 0.15

    scenario(test)


def test_offboard_takes_off_from_the_ground_when_the_setpoint_is_above() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(1.0)
        await r.go_external(setpoint(z=-1.5))
        arming = asyncio.create_task(r.operator.command(ARM, (1.0,)))
        await r.stream(setpoint(z=-1.5), 8.0)
        assert await arming == ACCEPTED
        assert r.body.position[2] == pytest.approx(-1.5, abs=0.1)

    scenario(test)


# Streams, parameters, services --------------------


async def rate(r: Rig, name: str, seconds: float = 10.0) -> float:
    seen = tap(r.pipes[0])
    await asyncio.sleep(seconds)
    return sum(m.get_type() == name for m in seen) / seconds


@pytest.mark.parametrize(("asked", "measured"), [(100.0, 99.3), (200.0, 124.0), (50.0, 49.65)])
def test_px4_streams_at_the_rates_that_were_measured(asked: float, measured: float) -> None:
    async def test(r: Rig) -> None:
        number = mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED
        assert await r.companion.command(INTERVAL, (number, 1e6 / asked)) == ACCEPTED
        await asyncio.sleep(1.0)
        assert await rate(r, "LOCAL_POSITION_NED") == pytest.approx(measured, rel=0.01)

    scenario(test, world=stand)


def test_intervals_belong_to_a_link_and_can_be_stopped_and_defaulted() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(1.0)
        number = float(mav.MAVLINK_MSG_ID_ODOMETRY)
        assert await r.companion.command(INTERVAL, (number, -1.0)) == ACCEPTED
        assert await rate(r, "ODOMETRY", 2.0) == 0.0
        assert await r.operator.command(INTERVAL, (number, 1e5)) == ACCEPTED
        assert await rate(r, "ODOMETRY", 2.0) == 0.0
        assert await r.companion.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, (number,)) == ACCEPTED
        assert r.companion.latest("MESSAGE_INTERVAL").interval_us == -1
        assert await r.companion.command(INTERVAL, (number, 0.0)) == ACCEPTED
        assert await rate(r, "ODOMETRY", 4.0) == pytest.approx(30.0, abs=1.0)
        assert await r.companion.command(INTERVAL, (9999.0, 1e5)) == FAILED
        assert await r.companion.command(INTERVAL, (number, float("nan"))) == DENIED

    scenario(test, world=stand)


def test_a_px4_port_talks_at_the_measured_thirty_kilobytes_unasked() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(2.0)
        total = 0

        def count(data: bytes) -> bytes:
            nonlocal total
            total += len(data)
            return data

        r.pipes[0].fault = count
        await asyncio.sleep(5.0)
        assert 15_000 < total / 5.0 < 35_000

    scenario(test, world=stand)


def test_messages_can_be_requested() -> None:
    async def test(r: Rig) -> None:
        request = mav.MAV_CMD_REQUEST_MESSAGE
        assert await r.operator.command(request, (float(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION),)) == ACCEPTED
        assert r.operator.latest("AUTOPILOT_VERSION").capabilities & mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        assert await r.operator.command(request, (4242.0,)) == DENIED
        assert await r.operator.command(request, (float("inf"),)) == DENIED
        assert await r.operator.command(mav.MAV_CMD_DO_MOUNT_CONTROL) == mav.MAV_RESULT_UNSUPPORTED

    scenario(test, world=stand)


def float_of_int(value: int) -> float:
    import struct

    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def int_of_float(value: float) -> int:
    import struct

    return int(struct.unpack("<i", struct.pack("<f", value))[0])


def test_px4_parameters_carry_whole_numbers_as_bytes() -> None:
    async def test(r: Rig) -> None:
        seen = tap(r.pipes[1])
        r.operator.send(mav.MAVLink_param_request_list_message(1, 1))
        await asyncio.sleep(0.1)
        table = {m.param_id: m for m in seen if m.get_type() == "PARAM_VALUE"}
        assert len(table) == table["COM_OF_LOSS_T"].param_count > 5
        assert table["COM_OF_LOSS_T"].param_value == 1.0
        assert int_of_float(table["COM_OBL_RC_ACT"].param_value) == 5

        async def put(name: bytes, value: float, kind: int) -> float:
            r.operator.send(mav.MAVLink_param_set_message(1, 1, name, value, kind))
            await asyncio.sleep(0.1)
            return float(r.operator.latest("PARAM_VALUE").param_value)

        assert int_of_float(await put(b"COM_OBL_RC_ACT", float_of_int(4), mav.MAV_PARAM_TYPE_INT32)) == 4
        assert int_of_float(await put(b"COM_OBL_RC_ACT", 3.0, mav.MAV_PARAM_TYPE_REAL32)) == 4
        assert await put(b"COM_OF_LOSS_T", 0.5, mav.MAV_PARAM_TYPE_REAL32) == 0.5
        assert await put(b"COM_OF_LOSS_T", float("nan"), mav.MAV_PARAM_TYPE_REAL32) == 0.5
        count = sum(m.get_type() == "PARAM_VALUE" for m in seen)
        r.operator.send(mav.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1))
        await asyncio.sleep(0.1)
        assert sum(m.get_type() == "PARAM_VALUE" for m in seen) == count

    scenario(test, world=stand)


def test_timesync_is_answered_in_time_since_boot() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(2.0)
        seen = tap(r.pipes[1])
        r.operator.send(mav.MAVLink_timesync_message(0, 123_456_789))
        await asyncio.sleep(0.01)
        (answer,) = [m for m in seen if m.get_type() == "TIMESYNC" and m.tc1 and m.get_srcComponent() == 1]
        assert answer.ts1 == 123_456_789
        assert answer.tc1 == pytest.approx(r.now * 1e9, abs=2e7)

    scenario(test, world=stand)


def test_a_reboot_is_silence_and_then_a_first_boot_again() -> None:
    async def test(r: Rig) -> None:
        number = float(mav.MAVLINK_MSG_ID_ATTITUDE)
        await r.companion.command(INTERVAL, (number, -1.0))
        await asyncio.sleep(1.0)
        assert await r.operator.command(mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (1.0,)) == ACCEPTED
        await asyncio.sleep(0.1)
        before = r.operator.messages
        await asyncio.sleep(1.8)
        assert r.operator.messages == before
        await asyncio.sleep(2.5)
        assert r.operator.messages > before
        assert r.operator.latest("ATTITUDE").time_boot_ms < 3000
        assert await rate(r, "ATTITUDE", 2.0) > 40.0

    scenario(test, world=stand)


def test_it_will_not_reboot_while_armed() -> None:
    async def test(r: Rig) -> None:
        await r.take_off()
        assert await r.operator.command(mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (1.0,)) == DENIED

    scenario(test)


def test_a_cut_link_comes_back() -> None:
    async def test(r: Rig) -> None:
        r.pipes[0].cut()
        await asyncio.sleep(3.0)
        assert r.companion.age("HEARTBEAT") < 1.5

    scenario(test, world=stand)


# Routing --------------------


def test_before_its_first_heartbeat_the_autopilot_answers_for_a_component() -> None:
    async def main() -> None:
        companion_pipe, ground_pipe = MemoryPipe(), MemoryPipe()
        autopilot = AutopilotStandIn(config(), ready_s=0.0)
        operator = OperatorLink([ground_pipe.opener(1)])
        async with asyncio.TaskGroup() as group:
            flying = group.create_task(autopilot.run(companion_pipe.opener(0), ground_pipe.opener(0)))
            async with operator.running():
                await operator.wait_for(lambda o: o.latest("HEARTBEAT") is not None, 2.0)
                arm = mav.MAVLink_command_long_message(*DAEMON, ARM, 0, 1.0, 0, 0, 0, 0, 0, 0)
                operator.send(arm)
                await asyncio.sleep(0.1)
                assert autopilot.armed  # the trap
                with pytest.raises(TimeoutError, match="has not been heard"):
                    await operator.command(ARM, (0.0,), target=DAEMON, timeout=2.0)
            flying.cancel()

    run_simulated(main())


def test_once_heard_a_component_gets_its_own_commands() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(1.5)
        seen = tap(r.pipes[0])
        with pytest.raises(TimeoutError, match="did not answer"):
            await r.operator.command(ARM, (1.0,), target=DAEMON, timeout=2.0)
        commands = [m for m in seen if m.get_type() == "COMMAND_LONG"]
        assert [m.confirmation for m in commands] == [0, 1, 2]
        assert commands[0].get_srcSystem() == 255
        assert not r.autopilot.armed

    scenario(test, world=stand)


def test_a_command_to_component_zero_reaches_both() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(1.5)
        seen = tap(r.pipes[0])
        r.operator.send(mav.MAVLink_command_long_message(1, 0, ARM, 0, 1.0, 0, 0, 0, 0, 0, 0))
        await asyncio.sleep(0.1)
        assert r.autopilot.armed
        assert [m.target_component for m in seen if m.get_type() == "COMMAND_LONG"] == [0]

    scenario(test, world=stand)


@pytest.mark.parametrize(
    ("message", "px4", "ardupilot"),
    [
        (tunnel(1), True, True),
        (tunnel(1, (255, 190)), True, True),
        (tunnel(1, (77, 1)), False, False),  # nobody of that name has been heard
        (mav.MAVLink_named_value_float_message(0, b"tension", 1.0), True, True),
        (mav.MAVLink_statustext_message(6, b"hello"), True, True),
        (mav.MAVLink_command_ack_message(64002, 0, 0, 0, 255, 190), True, True),
        (mav.MAVLink_param_value_message(b"ARM_X", 1.0, 9, 1, 0), True, True),
        (mav.MAVLink_component_metadata_message(0, 0, b""), True, False),
        (mav.MAVLink_arm_payload_message(0, 0.2, 0.1, (0, 0, 0), (0, 0, 0), 1), False, False),
    ],
    ids=lambda value: value.get_type() if hasattr(value, "get_type") else "",
)
def test_what_passes_from_the_companion_to_the_ground(message: Any, px4: bool, ardupilot: bool) -> None:
    for flavour, passes in (("px4", px4), ("ardupilot", ardupilot)):

        async def test(r: Rig, passes: bool = passes) -> None:
            await asyncio.sleep(0.5)
            r.companion.send(message)
            await asyncio.sleep(0.2)
            assert (r.operator.latest(message.get_type(), DAEMON) is not None) is passes

        scenario(test, flavour, world=stand)


@pytest.mark.parametrize(("gap", "arrive"), [(0.0, 5), (0.002, 59), (0.005, 100)])
def test_px4_drops_bursts_as_measured(gap: float, arrive: int) -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(0.55)
        seen = tap(r.pipes[1])
        for number in range(100):
            r.companion.send(tunnel(number))
            await asyncio.sleep(gap)
        await asyncio.sleep(0.5)
        tunnels = [m.payload[0] for m in seen if m.get_type() == "TUNNEL"]
        assert len(tunnels) == pytest.approx(arrive, abs=2)
        assert tunnels == sorted(tunnels)
        assert r.autopilot.counters.burst_dropped >= 100 - len(tunnels)

    scenario(test, world=stand)


def test_ardupilot_forwards_bursts_whole_but_four_milliseconds_late() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(0.55)
        seen = tap(r.pipes[1])
        for number in range(100):
            r.companion.send(tunnel(number))
        await asyncio.sleep(0.0035)
        assert not seen
        await asyncio.sleep(0.1)
        assert sum(m.get_type() == "TUNNEL" for m in seen) == 100

    scenario(test, "ardupilot", world=stand)


@pytest.mark.parametrize(
    ("flavour", "name", "value"), [("px4", b"MAV_1_FORWARD", 0), ("ardupilot", b"MAV2_OPTIONS", 2)]
)
def test_forwarding_is_a_parameter(flavour: str, name: bytes, value: int) -> None:
    async def test(r: Rig) -> None:
        wire = float_of_int(value) if flavour == "px4" else float(value)
        r.operator.send(mav.MAVLink_param_set_message(1, 1, name, wire, mav.MAV_PARAM_TYPE_INT32))
        await asyncio.sleep(0.2)
        r.companion.send(tunnel(1))
        await asyncio.sleep(0.2)
        assert r.operator.latest("TUNNEL", DAEMON) is None

    scenario(test, flavour, world=stand)


# ArduPilot --------------------


async def guided_take_off(r: Rig) -> None:
    await r.operator.wait_for(lambda o: o.latest("HEARTBEAT") is not None, 5.0)
    await asyncio.sleep(1.0)
    assert await r.operator.command(mav.MAV_CMD_DO_SET_MODE, (1.0, 4.0)) == ACCEPTED
    assert await r.operator.command(TAKEOFF, (0.0,) * 6 + (2.0,)) == FAILED  # not armed yet
    assert await r.operator.command(ARM, (1.0,)) == ACCEPTED
    await r.stream(setpoint(3.0, 0.0, -5.0), 2.0)
    assert r.autopilot.landed  # set-points do nothing before TAKEOFF
    assert await r.operator.command(TAKEOFF, (0.0,) * 6 + (2.0,)) == ACCEPTED
    await asyncio.sleep(8.0)
    assert r.body.position[2] == pytest.approx(-2.0, abs=0.1)
    assert r.heartbeat().custom_mode == 4


def test_ardupilot_is_ready_late_and_quiet() -> None:
    async def test(r: Rig) -> None:
        names: set[str] = set()
        seen = tap(r.pipes[0])
        await asyncio.sleep(41.0)
        names = {m.get_type() for m in seen if m.get_srcSystem() == 1 and m.get_srcComponent() == 1}
        assert names == {"HEARTBEAT", "TIMESYNC"}
        assert await r.operator.command(ARM, (1.0,)) == FAILED
        await asyncio.sleep(2.0)
        assert await r.operator.command(ARM, (1.0,)) == ACCEPTED

    scenario(test, "ardupilot", ready_s=None, world=stand)


def test_ardupilot_guided_flies_and_brakes_when_the_stream_stops() -> None:
    async def test(r: Rig) -> None:
        await guided_take_off(r)
        await r.stream(setpoint(1.0, 0.0, -2.0), 6.0)
        assert r.body.position[0] == pytest.approx(1.0, abs=0.1)
        velocity = setpoint(mask=0b111, vx=0.5)
        await r.stream(velocity, 2.0)
        await asyncio.sleep(2.5)
        assert r.body.velocity[0] > 0.3  # still at it, 2.5 s later
        await asyncio.sleep(4.0)
        assert abs(r.body.velocity[0]) < 0.05
        assert r.autopilot.mode is Mode.EXTERNAL
        assert r.heartbeat().system_status == mav.MAV_STATE_ACTIVE

    scenario(test, "ardupilot")


def test_ardupilot_stops_at_position_with_acceleration_but_no_velocity() -> None:
    async def test(r: Rig) -> None:
        await guided_take_off(r)
        await r.stream(setpoint(mask=0b111, vx=1.0), 3.0)
        assert r.body.velocity[0] > 0.7
        await r.stream(setpoint(9.0, 0.0, -2.0, mask=0b000_111_000), 5.0)
        assert abs(r.body.velocity[0]) < 0.15
        assert r.body.position[0] < 6.0

    scenario(test, "ardupilot")


def test_ardupilot_turns_its_nose_where_it_flies_unless_told() -> None:
    async def test(r: Rig) -> None:
        await guided_take_off(r)
        told = setpoint(0.0, 2.0, -2.0, mask=POSITION_ONLY)
        await r.stream(told, 3.0)
        assert abs(r.autopilot.estimate.yaw) < 0.05
        untold = setpoint(0.0, 6.0, -2.0, mask=POSITION_ONLY | mav.POSITION_TARGET_TYPEMASK_YAW_IGNORE)
        await r.stream(untold, 3.0)
        assert r.autopilot.estimate.yaw == pytest.approx(math.pi / 2, abs=0.3)

    scenario(test, "ardupilot")


def test_ardupilot_has_no_odometry_and_denies_more_than_333_hz() -> None:
    async def test(r: Rig) -> None:
        await asyncio.sleep(1.0)
        position = float(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
        assert await r.companion.command(INTERVAL, (331.0, 1e5)) == FAILED
        assert await r.companion.command(INTERVAL, (position, 2500.0)) == DENIED
        assert await r.companion.command(INTERVAL, (position, 1e4)) == ACCEPTED
        assert await rate(r, "LOCAL_POSITION_NED", 5.0) == pytest.approx(100.0, abs=1.0)
        assert await r.operator.command(mav.MAV_CMD_DO_SET_ACTUATOR) == mav.MAV_RESULT_UNSUPPORTED
        r.operator.send(mav.MAVLink_param_request_read_message(1, 1, b"MAV_SYSID", -1))
        await asyncio.sleep(0.1)
        assert r.operator.latest("PARAM_VALUE").param_value == 1.0  # by value, not by bytes

    scenario(test, "ardupilot", world=stand)


# Robustness --------------------


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_random_bytes_on_both_ports_are_survived(flavour: str) -> None:
    async def test(r: Rig) -> None:
        noise = random.Random(7)
        ends = [pipe.ends[1] for pipe in r.pipes]
        for _ in range(300):
            for end in ends:
                assert end is not None
                end.write(noise.randbytes(noise.randrange(1, 300)))
            await asyncio.sleep(0.01)
        assert r.autopilot.counters.bad > 100
        assert not r.autopilot.armed
        assert await r.operator.command(mav.MAV_CMD_REQUEST_MESSAGE, (148.0,)) == ACCEPTED

    scenario(test, flavour, world=stand)


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_wild_values_in_every_message_that_it_listens_to_are_survived(flavour: str) -> None:
    """Right checksums, random payloads: all that a handler reads may be anything that the wire can carry."""
    heard = "command_long command_int set_mode set_position_target_local_ned param_request_read param_set timesync ping"
    commands = [11, 21, 22, 176, 211, 246, 400, 510, 511, 512, 520, 65535]

    async def test(r: Rig) -> None:
        wild = random.Random(11)
        codec = mav.MAVLink(None, 255, 190)
        end = r.pipes[1].ends[1]
        assert end is not None
        reals = [math.nan, math.inf, -math.inf, 0.0, 1.0, -1.0, 3e38, 21196.0, 512.0]
        for _ in range(1500):
            cls = getattr(mav, f"MAVLink_{wild.choice(heard.split())}_message")
            raw = cls.unpacker.unpack(wild.randbytes(cls.unpacker.size))
            fields = dict(zip(cls.ordered_fieldnames, raw, strict=True))
            for name, value in fields.items():
                if isinstance(value, float) and wild.random() < 0.7:
                    fields[name] = wild.choice(reals)
            fields |= {name: 1 for name in fields if name.startswith("target_")}
            if "command" in fields:
                fields["command"] = wild.choice(commands)
            end.write(cls(**fields).pack(codec))
            await asyncio.sleep(0.003)
        await asyncio.sleep(4.0)
        assert r.operator.age("HEARTBEAT") < 1.5
        assert all(math.isfinite(part) for part in r.body.position)

    scenario(test, flavour)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not() -> None:
    def flight(seed: int) -> bytes:
        sent = bytearray()

        async def test(r: Rig) -> None:
            def record(data: bytes) -> bytes:
                sent.extend(data)
                return data

            r.pipes[0].fault = record
            await asyncio.sleep(1.2)
            assert await r.operator.command(TAKEOFF) == ACCEPTED
            assert await r.operator.command(ARM, (1.0,)) == ACCEPTED
            await asyncio.sleep(3.0)
            assert r.body.position[2] < -0.1

        scenario(test, seed=seed)
        return bytes(sent)

    first = flight(3)
    assert len(first) > 30_000
    assert flight(3) == first
    assert flight(4) != first


# The operator's own rules --------------------


def test_the_operator_reports_progress_and_the_final_result_only_from_the_one_it_asked() -> None:
    async def main() -> None:
        pipe = MemoryPipe()
        operator = OperatorLink([pipe.opener(1)])
        daemon = mav.MAVLink(None, *DAEMON)
        stranger = mav.MAVLink(None, 1, 77)
        asked = asyncio.Event()
        end = await pipe.opener(0)(lambda data: asked.set() if len(data) > 30 else None)

        async def answer() -> None:
            heartbeat = mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
            await asyncio.sleep(1.0)
            assert not asked.is_set()  # nothing is sent to a component that has not been heard
            end.write(heartbeat.pack(daemon))
            await asked.wait()
            for codec, result, percent in (
                (stranger, ACCEPTED, 0),
                (daemon, mav.MAV_RESULT_IN_PROGRESS, 30),
                (daemon, mav.MAV_RESULT_IN_PROGRESS, 60),
                (daemon, FAILED, 0),
            ):
                await asyncio.sleep(4.0 if percent else 0.1)
                end.write(mav.MAVLink_command_ack_message(64002, result, percent, 0, 255, 190).pack(codec))

        async with operator.running():
            steps: list[int] = []
            answering = asyncio.create_task(answer())
            result = await operator.command(64002, target=DAEMON, timeout=5.0, progress=steps.append)
            await answering
        assert result == FAILED
        assert steps == [30, 60]
        end.close()

    run_simulated(main())


def test_the_operator_prefers_its_first_link_and_hears_a_text_once() -> None:
    async def main() -> None:
        direct, relayed = MemoryPipe(), MemoryPipe()
        operator = OperatorLink([direct.opener(1), relayed.opener(1)])
        sent: dict[str, bytearray] = {"direct": bytearray(), "relayed": bytearray()}
        ends = [await direct.opener(0)(sent["direct"].extend), await relayed.opener(0)(sent["relayed"].extend)]
        daemon = mav.MAVLink(None, *DAEMON)

        def say(which: int, message: Any) -> None:
            ends[which].write(message.pack(daemon))

        heartbeat = mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
        async with operator.running():
            await asyncio.sleep(0.1)
            say(1, heartbeat)
            await asyncio.sleep(0.1)
            before = len(sent["relayed"])
            operator.send(tunnel(1), DAEMON)
            await asyncio.sleep(0.1)
            assert len(sent["relayed"]) > before + 10
            say(0, heartbeat)
            say(0, mav.MAVLink_statustext_message(6, b"gripped"))
            say(1, mav.MAVLink_statustext_message(6, b"gripped"))
            await asyncio.sleep(0.1)
            before = len(sent["relayed"])
            operator.send(tunnel(2), DAEMON)
            await asyncio.sleep(0.1)
            assert len(sent["relayed"]) == before
            assert [text.text for text in operator.texts] == ["gripped"]
        for end in ends:
            end.close()

    run_simulated(main())
