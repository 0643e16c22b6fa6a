"""Targets and set-points: what is taken, what is refused, and how long it counts."""

import asyncio
import math
from typing import Any

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S
from arm_companion.mission.facts import GraspTarget, SetpointKind
from arm_companion.protocol.dialect import mav
from tests.unit.component_rig import ServiceRig, serve

NAN = math.nan


def target(**changes: Any) -> Any:
    values: dict[str, Any] = {
        "target_system": 1, "target_component": 192, "time_usec": 0, "kind": mav.ARM_TARGET_KIND_BAR,
        "frame": mav.MAV_FRAME_LOCAL_NED, "position": [3.0, 1.0, -2.0], "axis": [0.0, 2.0, 0.0], "q": [NAN] * 4,
        "radius": 0.02, "position_covariance": [NAN] * 6, "direction_sigma": NAN,
    }  # fmt: skip
    return mav.MAVLink_arm_target_message(**{**values, **changes})


def setpoint(**changes: Any) -> Any:
    values: dict[str, Any] = {
        "target_system": 1, "target_component": 192, "time_usec": 0, "kind": mav.ARM_SETPOINT_KIND_BEND,
        "theta": 0.5, "delta": -1.0, "tip_position": [NAN] * 3, "timeout": 0.5,
    }  # fmt: skip
    return mav.MAVLink_arm_setpoint_message(**{**values, **changes})


def stamp(seconds_ago: float) -> int:
    now = SIMULATED_EPOCH_S + asyncio.get_running_loop().time()
    return round((now - seconds_ago) * 1e6)


async def soon() -> None:
    await asyncio.sleep(0.01)


COVARIANCE = [0.04, 0.01, 0.0, 0.04, 0.0, 0.09]


def test_a_bar_comes_with_its_uncertainty_and_age() -> None:
    async def body(rig: ServiceRig) -> None:
        guidance = rig.component.guidance
        assert guidance.bar_age_s == math.inf
        rig.ground.send(target(time_usec=stamp(0.3), position_covariance=COVARIANCE, direction_sigma=0.1))
        await soon()
        bar = guidance.take_bar()
        assert bar is not None
        assert bar.covariance_w == pytest.approx(COVARIANCE)
        assert bar.direction_sigma == pytest.approx(0.1)
        assert guidance.bar_age_s == pytest.approx(0.31, abs=0.001)

    serve(body)


def test_whoever_told_a_target_can_ask_whether_it_was_taken() -> None:
    async def body(rig: ServiceRig) -> None:
        ask = (mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_ARM_TARGET)
        rig.ground.command(*ask, mav.ARM_TARGET_KIND_BAR)
        await soon()
        assert rig.ground.all("ARM_TARGET") == []
        assert "temporarily rejected: there is nothing to tell yet" in rig.words()
        rig.ground.send(target(position=[1.0, 2.0, -3.0]), target(kind=1, q=[NAN] * 4), target(radius=-1.0))
        await soon()
        rig.ground.command(*ask, mav.ARM_TARGET_KIND_BAR)
        await soon()
        (told,) = rig.ground.all("ARM_TARGET")
        assert (told.kind, tuple(told.position), told.target_system) == (0, (1.0, 2.0, -3.0), 0)
        assert told.radius > 0.0

    serve(body)


def test_what_is_not_told_is_none() -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(target(position_covariance=[0.0] * 6, direction_sigma=0.0))
        await soon()
        bar = rig.component.guidance.take_bar()
        assert bar is not None
        assert (bar.covariance_w, bar.direction_sigma) == (None, None)

    serve(body)


def test_an_object_is_kept_beside_the_bar() -> None:
    async def body(rig: ServiceRig) -> None:
        guidance = rig.component.guidance
        assert guidance.grasp_target == (None, math.inf)
        rig.ground.send(target(kind=1, q=[0.98, 0.0, 0.0, 0.199], axis=[NAN] * 3, radius=0.03))
        await soon()
        thing, age = guidance.grasp_target
        assert isinstance(thing, GraspTarget)
        assert thing.attitude_wo is not None
        assert math.hypot(*thing.attitude_wo) == pytest.approx(1.0)
        assert age == pytest.approx(0.01, abs=0.005)
        assert guidance.take_bar() is None
        rig.ground.send(target(kind=1, q=[NAN] * 4))
        await soon()
        assert guidance.grasp_target[0] is not None
        assert guidance.grasp_target[0].attitude_wo is None

    serve(body)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"position_covariance": [-1.0, 0.0, 0.0, 1.0, 0.0, 1.0]}, "no covariance"),
        ({"position_covariance": [1.0, 2.0, 0.0, 1.0, 0.0, 1.0]}, "no covariance"),
        ({"position_covariance": [1.0, 0.0, 0.0, math.inf, 0.0, 1.0]}, "not finite"),
        ({"direction_sigma": -0.1}, "direction_sigma"),
        ({"direction_sigma": 10.0}, "direction_sigma"),
        ({"kind": 1, "q": [1.0, 1.0, 0.0, 0.0]}, "unit quaternion"),
        ({"kind": 1, "q": [1.0, NAN, 0.0, 0.0]}, "unit quaternion"),
        ({"kind": 1, "radius": -1.0}, "radius"),
    ],
)
def test_impossible_uncertainty_and_attitude_are_refused(changes: dict[str, Any], reason: str) -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(target(**changes))
        await soon()
        assert rig.component.guidance.take_bar() is None
        assert rig.component.guidance.grasp_target[0] is None
        assert reason in rig.words()

    serve(body)


@pytest.mark.parametrize("make", [target, setpoint])
def test_what_is_old_or_from_the_future_is_refused(make: Any) -> None:
    async def body(rig: ServiceRig) -> None:
        await asyncio.sleep(20.0)
        for age, reason in ((3.0, "3 s old; at most 2 s are allowed"), (-2.0, "ahead of ours"), (1e9, "s old")):
            rig.ground.received.clear()
            rig.ground.send(make(time_usec=stamp(age)))
            await asyncio.sleep(2.5)
            assert reason in rig.words()
        guidance = rig.component.guidance
        assert guidance.take_bar() is None
        assert guidance.setpoint is None
        assert guidance.counters.bad_targets + guidance.counters.bad_setpoints == 3

    serve(body)


def test_what_comes_twice_or_out_of_order_counts_once() -> None:
    async def body(rig: ServiceRig) -> None:
        newest, older = target(time_usec=stamp(0.1)), target(time_usec=stamp(0.2), radius=0.05)
        rig.ground.send(newest, older, newest)
        await soon()
        bar = rig.component.guidance.take_bar()
        assert bar is not None
        assert bar.radius == pytest.approx(0.02)
        assert (rig.component.guidance.counters.targets, rig.component.guidance.counters.late) == (1, 2)

    serve(body)


def test_a_setpoint_counts_until_its_timeout() -> None:
    async def body(rig: ServiceRig) -> None:
        guidance = rig.component.guidance
        rig.ground.send(setpoint())
        await asyncio.sleep(0.3)
        taken = guidance.setpoint
        assert taken is not None
        assert (taken.kind, taken.theta, taken.delta) == (SetpointKind.BEND, 0.5, -1.0)
        assert taken.age_s == pytest.approx(0.3, abs=0.01)
        await asyncio.sleep(0.21)
        assert guidance.setpoint is None
        rig.ground.send(setpoint(kind=1, theta=NAN, delta=NAN, tip_position=[0.1, 0.0, 0.2]))
        await soon()
        tip = guidance.setpoint
        assert tip is not None
        assert tip.tip_a == pytest.approx((0.1, 0.0, 0.2))

    serve(body)


@pytest.mark.parametrize("order", ["STOW", "ABORT"])
def test_a_way_to_safety_ends_the_stream(order: str) -> None:
    async def body(rig: ServiceRig) -> None:
        rig.ground.send(setpoint())
        rig.ground.command(getattr(mav, f"MAV_CMD_ARM_{order}"))
        await soon()
        rig.component.take()
        assert rig.component.guidance.setpoint is None

    serve(body)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"theta": NAN}, "theta"),
        ({"theta": 5.6}, "theta"),
        ({"delta": math.inf}, "delta"),
        ({"delta": 7.0}, "delta"),
        ({"kind": 1}, "tip_position"),
        ({"kind": 1, "tip_position": [0.0, 0.0, 99.0]}, "tip_position"),
        ({"kind": 9}, "kind 9"),
        ({"timeout": NAN}, "timeout"),
        ({"timeout": 0.0}, "timeout"),
        ({"timeout": 60.0}, "timeout"),
    ],
)
def test_an_impossible_setpoint_is_refused_with_the_reason(changes: dict[str, Any], reason: str) -> None:
    async def body(rig: ServiceRig) -> None:
        for _ in range(5):
            rig.ground.send(setpoint(**changes))
        await soon()
        assert rig.component.guidance.setpoint is None
        assert rig.words().count("set-point refused") == 1
        assert reason in rig.words()
        assert rig.component.guidance.counters.bad_setpoints == 5

    serve(body)


def test_a_step_of_the_computers_clock_is_told_once_for_each() -> None:
    """What a vision program on this computer stamps is refused from then on, and people must know why."""

    async def body(rig: ServiceRig) -> None:
        loop, set_by = asyncio.get_running_loop(), [0.0]
        rig.component._clock._wall = lambda: SIMULATED_EPOCH_S + loop.time() + set_by[0]
        await asyncio.sleep(3.0)
        assert "clock" not in rig.words()
        set_by[0] = 3600.0
        await asyncio.sleep(3.0)
        assert rig.words().count("clock was set and is 3600.0 s ahead of ours") == 1
        rig.ground.send(target(time_usec=stamp(-3600.0)))
        await soon()
        assert rig.component.guidance.take_bar() is None
        assert "ahead of ours" in rig.words()
        set_by[0] = -2.0
        await asyncio.sleep(3.0)
        assert rig.words().count("clock was set and is 2.0 s behind ours") == 1

    serve(body)
