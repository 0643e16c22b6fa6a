"""REACH in the mission: what is asked of vehicle and arm, how they share what the vehicle is off, and how it ends."""

import dataclasses
import math
import re
from collections.abc import Callable

import numpy as np
import pytest

from arm_companion.arm import arc, statics
from arm_companion.geometry import so3
from arm_companion.mission.facts import ArmFault, Control, Facts, Order, Result, Setpoint
from arm_companion.mission.motion import Reference, add, norm, sub
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.reaching import bend_limit, move
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase, State, Vigil
from arm_companion.record_codec import dumps, loads
from tests.unit.conftest import tendons
from tests.unit.mission_rig import PLACE, Run, ask, memory, vehicle

Hovering = Callable[..., Facts]
Vec3 = tuple[float, float, float]

TIP: Vec3 = (2.0, 0.0, -2.2 + 0.37)
"""Of the straight arm at PLACE."""
LAG_S = 0.4
SERVO_S = 0.05
STEP_S = 0.02


class World:
    """A vehicle that lags behind its set-points and is pushed aside, and an arm that lags behind its goals."""

    def __init__(self, run: Run, hovering: Hovering, push: Callable[[float], Vec3] = lambda _: (0.0, 0.0, 0.0)) -> None:
        self.run, self.t, self._quiet, self._push = run, 0.0, hovering(), push
        self.place, self.off, self.bend = np.array(PLACE), np.zeros(3), np.array(run.state.bend)
        self.setpoints: list[Setpoint] = []
        self.tips: list[float] = []
        self.flies = True

    @property
    def facts(self) -> Facts:
        x, y, z = (self.place + self.off).tolist()
        model = self.run.parameters.model
        pulls = model.pull_for_bend(self.bend)
        tensions = statics.stretch_tension(model.parameters, self.bend, pulls)
        said = tendons(tuple(pulls.tolist()), tuple(tensions.tolist()))
        return dataclasses.replace(vehicle(position_w=(x, y, z))(self._quiet), tendons=said)

    def tip(self) -> np.ndarray:
        model, mount = self.run.parameters.model, self.run.parameters.mount
        pulls = np.array([tendon.pull for tendon in self.facts.tendons])
        tip_a = model.free(pulls, np.array([0.0, 0.0, 9.81])).tip_position
        return np.asarray(self.place + self.off + mount.position + mount.rotation @ tip_a)

    def go(self, seconds: float, change: Callable[[Facts], Facts] = lambda facts: facts) -> "World":
        """Let time pass; the change of facts counts once."""
        for _ in range(round(seconds / STEP_S)):
            self.t += STEP_S
            before = self.off
            self.off = np.array(self._push(self.t))
            speed = tuple(((self.off - before) / STEP_S).tolist())
            commands = self.run.cycle(change(vehicle(velocity_w=speed)(self.facts)), STEP_S)
            change = lambda facts: facts  # noqa: E731
            if commands.setpoint is not None and self.flies:
                self.setpoints.append(commands.setpoint)
                self.place = self.place + STEP_S / LAG_S * (np.array(commands.setpoint.position_w) - self.place)
            self.bend = self.bend + STEP_S / SERVO_S * (np.array(self.run.state.bend) - self.bend)
            if (reach := self.run.state.reach) is not None and round(self.t / STEP_S) % 5 == 0:
                self.tips.append(float(np.linalg.norm(self.tip() - reach.target_w)))
        return self


def ready() -> State:
    return memory(Phase.READY)


def options(parameters: Parameters, **reach: float) -> Parameters:
    changed = dataclasses.replace(parameters.config.reach, **reach)
    return Parameters(dataclasses.replace(parameters.config, reach=changed), parameters.model)


def reach_to(point: Vec3, kind: float = 0.0, request: int = 7) -> Callable[[Facts], Facts]:
    return lambda facts: ask(facts, Order.REACH, kind, *point, request=request)


def results(run: Run, request: int = 7) -> list[Result]:
    return [answer.result for said in run.said for answer in said.answers if answer.request == request]


def reasons(run: Run) -> str:
    return "; ".join(answer.reason for said in run.said for answer in said.answers)


def beside(x: float, y: float, z: float) -> Vec3:
    return (TIP[0] + x, TIP[1] + y, TIP[2] + z)


@pytest.mark.parametrize("step", [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (-0.3, 0.8, 0.2), (0.0, 0.0, -0.1)])
def test_the_tip_comes_to_the_point_and_stays_there(step: Vec3, parameters: Parameters, hovering: Hovering) -> None:
    world = World(Run(ready(), parameters), hovering)
    world.go(12.0, reach_to(beside(*step)))
    assert world.run.phases == [Phase.READY, Phase.TIP_MOVE, Phase.TIP_HOLD]
    assert results(world.run)[0] is Result.IN_PROGRESS
    assert results(world.run)[-1] is Result.ACCEPTED
    assert any("mm from its point" in text for text in world.run.texts)
    assert max(world.tips[-25:]) < 2e-3, "against the rod model under gravity, which the plan knows nothing of"
    assert world.run.said[-1].status.behaviour == "jog"


def test_the_setpoints_are_smooth_bounded_and_belong_together(parameters: Parameters, hovering: Hovering) -> None:
    """Also when a new point is ordered on the way, in another direction."""
    world = World(Run(ready(), parameters), hovering)
    world.go(2.0, reach_to(beside(1.5, 0.5, -0.3)))
    world.go(1.0, reach_to(beside(-0.5, 1.0, 0.1), request=8))
    world.go(12.0, reach_to(beside(0.0, -0.5, 0.0), request=9))
    assert results(world.run)[-1] is Result.CANCELLED
    assert results(world.run, 8)[-1] is Result.CANCELLED
    assert results(world.run, 9)[-1] is Result.ACCEPTED
    reach = parameters.config.reach
    fastest = max(norm(one.velocity_w) for one in world.setpoints)
    assert 0.9 * reach.speed_m_per_s < fastest <= reach.speed_m_per_s + 1e-9
    for before, after in zip(world.setpoints, world.setpoints[1:], strict=False):
        assert norm(after.acceleration_w) <= reach.acceleration_m_per_s2 + 1e-9
        assert after.acceleration_w == after.path_w
        moved = sub(after.position_w, before.position_w)
        assert norm(sub(moved, tuple(STEP_S * v for v in after.velocity_w))) < 2e-5  # type: ignore[arg-type]
        pushed = sub(after.velocity_w, before.velocity_w)
        assert norm(sub(pushed, tuple(STEP_S * a for a in after.acceleration_w))) < 2e-5  # type: ignore[arg-type]
        jerk = norm(sub(after.acceleration_w, before.acceleration_w)) / STEP_S
        assert jerk <= 2.0 * reach.acceleration_m_per_s2 / 0.2


def test_the_vehicle_stays_within_its_limits_on_all_of_the_way(parameters: Parameters, hovering: Hovering) -> None:
    high = options(parameters, height_min_m=2.0, move_max_m=1.0)
    world = World(Run(ready(), high), hovering)
    world.go(10.0, reach_to(beside(0.6, 0.0, 0.19)))
    assert world.run.state.phase is Phase.TIP_HOLD
    assert max(one.position_w[2] for one in world.setpoints) <= -2.0 + 1e-9
    world.go(0.1, reach_to(beside(0.0, 0.0, 0.4)))
    assert "it stays above 2 m" in reasons(world.run)
    world.go(0.1, reach_to(beside(3.0, 0.0, 0.0)))
    assert "at most 1 m" in reasons(world.run)
    assert world.run.state.phase is Phase.TIP_HOLD


def swaying(t: float) -> Vec3:
    return (0.05 * math.sin(1.5 * t), 0.04 * math.sin(1.1 * t + 1.0), 0.0)


def test_the_arm_makes_up_for_a_vehicle_that_does_not_keep_still(parameters: Parameters, hovering: Hovering) -> None:
    errors = {}
    for correction in (0.8, 0.0):
        slack = options(parameters, correction_max_rad=correction, tolerance_m=0.2)
        world = World(Run(ready(), slack), hovering, swaying)
        world.go(14.0, reach_to(beside(0.1, 0.05, -0.01)))
        errors[correction] = float(np.sqrt(np.mean(np.square(world.tips[-75:]))))
    assert errors[0.0] > 0.03
    assert errors[0.8] < 0.2 * errors[0.0]


def test_the_arm_makes_up_for_a_vehicle_that_leans(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.TIP_HOLD), parameters)
    lean = 0.1
    attitude = (math.cos(lean / 2.0), 0.0, math.sin(lean / 2.0), 0.0)  # nose up: the arm swings forward
    run.cycles(hovering(attitude_wb=attitude), 2.0)
    mount, length = parameters.mount, parameters.config.arm.length_m
    tip = so3.from_quaternion(attitude) @ (mount.position + arc.tip_position(run.state.bend, length)) + PLACE
    away = np.linalg.norm(tip - TIP)
    assert away < 0.4 * 0.37 * lean
    assert np.linalg.norm((tip - TIP)[:2]) < 0.006


def test_the_correction_keeps_to_its_limit(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.TIP_HOLD), parameters)
    run.cycles(hovering(position_w=(PLACE[0] + 0.3, PLACE[1], PLACE[2])), 3.0)
    assert math.hypot(*run.state.bend) == pytest.approx(parameters.config.reach.correction_max_rad)
    assert run.state.bend[0] < 0.0
    assert run.phases == [Phase.TIP_HOLD]
    assert any("mm from its point; the arm does what it can" in text for text in run.texts)


def test_no_bend_exceeds_what_tension_and_displacement_allow(parameters: Parameters, hovering: Hovering) -> None:
    limits = dataclasses.replace(parameters.config.limits, tension_max_n=12.0)
    gentle = Parameters(dataclasses.replace(parameters.config, limits=limits), parameters.model)
    s = Situation(ready(), hovering(), 100.0, gentle)
    most = bend_limit(s)
    assert 0.5 < most < limits.bend_max_rad
    arm = parameters.config.arm
    for theta in np.linspace(0.0, most, 10):
        pretension = max(arm.tendons.pretension_n, s.tension_swing(theta) + limits.tension_min_n)
        pulls = gentle.model.pull_for_bend(np.array((theta, 0.0)), pretension)
        free = gentle.model.free(pulls, np.zeros(3))
        assert free.tension.max() <= 0.8 * limits.tension_max_n + 0.05
        assert np.abs(pulls).max() <= limits.pull_max_m
    tight = dataclasses.replace(limits, tension_max_n=45.0, pull_max_m=0.05)
    short = Parameters(dataclasses.replace(parameters.config, limits=tight), parameters.model)
    most = bend_limit(Situation(ready(), hovering(), 100.0, short))
    pulls = short.model.pull_for_bend(np.array((most, 0.0)), s.tension_swing(most) + limits.tension_min_n)
    assert 0.04 < np.abs(pulls).max() <= 0.05


def test_a_vehicle_that_is_not_ours_is_left_alone_and_the_arm_reaches_what_it_can(
    parameters: Parameters, hovering: Hovering
) -> None:
    bend = np.array((0.5, -0.4))
    x, y, z = arc.tip_position(bend, 0.25).tolist()
    flown = vehicle(control=Control.PILOT, mode="POSCTL")
    run = Run(memory(Phase.READY, control=Control.PILOT, reference=None), parameters)
    run.cycle(reach_to((PLACE[0] + x, PLACE[1] + y, PLACE[2] + 0.12 + z))(flown(hovering())))
    for share in (0.3, 0.6, 0.9, 1.0, 1.0, 1.0):
        run.cycles(flown(hovering(tuple((share * bend).tolist()))), 1.0)
    assert run.state.phase is Phase.TIP_HOLD
    assert run.state.bend == pytest.approx(tuple(bend.tolist()), abs=0.05)
    own = [said.setpoint for said in run.said if said.setpoint is not None]
    assert all(one.position_w == PLACE and norm(one.velocity_w) == 0.0 for one in own), "the stream stays where it is"
    run.cycle(reach_to((PLACE[0] + 0.5, PLACE[1], -1.9))(flown(hovering())))
    assert "cm away from the point; the vehicle is not ours to move" in reasons(run)


def test_the_vehicle_stays_when_it_is_told_to(parameters: Parameters, hovering: Hovering) -> None:
    x, y, z = arc.tip_position((0.6, 0.3), 0.25).tolist()
    world = World(Run(ready(), parameters), hovering)
    world.go(6.0, reach_to((PLACE[0] + x, PLACE[1] + y, PLACE[2] + 0.12 + z), kind=1.0))
    assert world.run.state.phase is Phase.TIP_HOLD
    assert {one.position_w for one in world.setpoints} == {PLACE}
    assert world.tips[-1] < 2e-3


def test_a_vehicle_that_is_told_to_stay_on_its_way_brakes_smoothly(parameters: Parameters, hovering: Hovering) -> None:
    world = World(Run(ready(), parameters), hovering)
    world.go(3.0, reach_to(beside(1.5, 0.0, 0.0)))
    here = world.setpoints[-1]
    assert here.velocity_w[0] > 0.25
    stop = here.position_w[0] + 0.21
    world.go(5.0, reach_to((stop + 0.05, 0.0, beside(0.0, 0.0, -0.006)[2]), kind=1.0, request=8))
    assert results(world.run, 8)[-1] is Result.ACCEPTED
    assert world.setpoints[-1].position_w[0] == pytest.approx(stop, abs=0.02)
    most = parameters.config.reach.acceleration_m_per_s2 * STEP_S
    for before, after in zip(world.setpoints, world.setpoints[1:], strict=False):
        assert norm(sub(after.velocity_w, before.velocity_w)) <= most + 1e-9


def test_an_earlier_reach_somewhere_else_leaves_nothing_behind(parameters: Parameters, hovering: Hovering) -> None:
    world = World(Run(ready(), parameters), hovering)
    world.go(4.0, reach_to(beside(0.05, 0.0, 0.0)))
    world.go(2.5, lambda facts: ask(facts, Order.READY))
    assert world.run.state.phase is Phase.READY
    world.place = world.place + np.array((1.0, 0.0, 0.0))  # flown there by somebody else, long ago
    x, y, z = world.place.tolist()
    world.run.state = dataclasses.replace(world.run.state, reference=Reference((x, y, z)), vigil=Vigil())
    world.tips.clear()
    world.go(1.0, reach_to((x, y, z + 0.37)))
    assert max(math.hypot(*said.status.tip_position_a[:2]) for said in world.run.said[-100:]) < 0.03


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (vehicle(landed=True), "not flying"),
        (vehicle(armed=False), "not flying"),
        (vehicle(position_age_s=3.0), "vehicle state is"),
    ],
)
def test_what_is_not_possible_now_is_refused_in_words(
    change: Callable[[Facts], Facts], words: str, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(ready(), parameters)
    run.cycles(reach_to(TIP)(change(hovering())), 0.05)
    assert words in reasons(run)
    assert run.phases == [Phase.READY]


def test_after_a_pilot_had_the_vehicle_a_person_says_ready_first(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.READY), parameters)
    run.cycles(hovering(control=Control.PILOT, mode="POSCTL"), 0.1)
    run.cycles(reach_to(TIP)(hovering()), 0.1)
    assert "order READY first" in reasons(run)
    run.cycles(ask(hovering(), Order.READY), 0.1)
    run.cycles(reach_to(TIP, request=8)(hovering()), 0.1)
    assert run.state.phase is Phase.TIP_MOVE


@pytest.mark.parametrize("phase", [Phase.STOWED, Phase.PERCHED, Phase.APPROACH, Phase.HOLDING, Phase.CARRY])
def test_no_other_state_reaches(phase: Phase, parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(phase), parameters)
    run.cycle(reach_to(TIP)(hovering()))
    assert results(run) == [Result.TEMPORARILY_REJECTED]
    assert run.state.reach is None


@pytest.mark.parametrize(
    ("order", "after"), [(Order.STOW, Phase.STOWING), (Order.ABORT, Phase.STOWING), (Order.READY, Phase.READYING)]
)
@pytest.mark.parametrize("phase", [Phase.TIP_MOVE, Phase.TIP_HOLD])
def test_it_is_left_by_an_order_and_the_vehicle_stays_where_it_is_asked_to_be(
    phase: Phase, order: Order, after: Phase, parameters: Parameters, hovering: Hovering
) -> None:
    run = Run(memory(phase), parameters)
    run.cycles(hovering(), 0.1)
    run.cycles(ask(hovering(), order), 0.1)
    assert run.phases == [phase, after]
    setpoint = run.said[-1].setpoint
    assert setpoint is not None
    assert setpoint.position_w == pytest.approx(PLACE, abs=1e-6)
    assert setpoint.path_w == (0.0, 0.0, 0.0)


def test_the_pilot_who_takes_the_vehicle_ends_it_and_a_pilot_who_has_it_does_not(
    parameters: Parameters, hovering: Hovering
) -> None:
    flown = hovering(control=Control.PILOT, mode="POSCTL")
    taken, had = Run(memory(Phase.TIP_MOVE), parameters), Run(memory(Phase.TIP_MOVE, control=Control.PILOT), parameters)
    taken.cycles(hovering(), 0.1)
    assert taken.cycle(flown).setpoint is None
    assert taken.state.phase is Phase.STOWING
    assert taken.state.errors & ArmFault.PILOT_TOOK_OVER
    had.cycles(flown, 0.3)
    assert Phase.STOWING not in had.phases


def test_a_tip_that_does_not_get_there_in_time_is_told_and_stays(parameters: Parameters, hovering: Hovering) -> None:
    hasty = options(parameters, state_timeout_s=3.0, correction_max_rad=0.0)
    world = World(Run(ready(), hasty), hovering, lambda _: (0.05, 0.0, 0.0))
    world.go(5.0, reach_to(beside(0.1, 0.0, 0.0)))
    assert world.run.phases == [Phase.READY, Phase.TIP_MOVE, Phase.TIP_HOLD]
    assert results(world.run)[-1] is Result.FAILED
    assert re.search(r"after 3 s the tip (4[6-9]|5[0-3]) mm from its point", reasons(world.run))
    assert world.run.state.errors & ArmFault.TIMEOUT


def test_a_new_point_on_the_way_has_all_of_the_time(parameters: Parameters, hovering: Hovering) -> None:
    hasty = options(parameters, state_timeout_s=7.0)
    world = World(Run(ready(), hasty), hovering)
    world.go(5.0, reach_to(beside(1.3, 0.0, 0.0)))
    world.go(6.9, reach_to(beside(0.2, 0.0, 0.0), request=8))
    assert results(world.run, 8)[-1] is Result.ACCEPTED


def test_its_progress_is_the_share_of_the_tips_way(parameters: Parameters, hovering: Hovering) -> None:
    world = World(Run(ready(), parameters), hovering)
    world.go(8.0, reach_to(beside(1.0, 0.0, 0.0)))
    told = [said.status.progress for said in world.run.said if said.status.state == "TIP_MOVE"][50::25]
    assert told == sorted(told)
    assert told[0] < 20
    assert told[-1] > 95


def test_its_memory_can_be_recorded(parameters: Parameters, hovering: Hovering) -> None:
    world = World(Run(ready(), parameters), hovering)
    world.go(1.0, reach_to(beside(0.5, 0.0, 0.0)))
    assert loads(State, dumps(world.run.state)).reach == world.run.state.reach


def test_the_correction_never_bends_into_the_keep_out_cone(parameters: Parameters, hovering: Hovering) -> None:
    keep_out = parameters.keep_out
    assert keep_out is not None
    bent = memory(Phase.TIP_HOLD, bend=(4.0, 0.0), bend_goal=(4.0, 0.0))
    assert bent.reach is not None
    x, _, z = arc.tip_position((4.0, 0.0), 0.25).tolist()
    goal = dataclasses.replace(
        bent.reach,
        target_w=(PLACE[0] + x, 0.0, PLACE[2] + 0.12 + z),
        bend=(4.0, 0.0),
        shape=dataclasses.replace(bent.reach.shape, lead=Reference((4.0, 0.0, 0.0)), position=(4.0, 0.0, 0.0)),
    )
    run = Run(dataclasses.replace(bent, reach=goal), options(parameters, correction_max_rad=2.0))
    for off in np.linspace(0.0, 0.2, 20):
        run.cycles(hovering((4.0, 0.0), position_w=(PLACE[0] + float(off), PLACE[1], PLACE[2] + float(off))), 0.2)
        assert keep_out.clearance(np.asarray(run.state.bend)) >= 0.0


@pytest.mark.parametrize(("flown", "yaw"), [((0.0, 0.0, 0.0), 1.0), ((0.0, 8.0, 0.0), 0.0), ((0.05, 0.0, 0.0), 0.0)])
def test_a_vehicle_that_becomes_ours_is_asked_to_be_where_it_is(
    flown: Vec3, yaw: float, parameters: Parameters, hovering: Hovering
) -> None:
    pilot = {"control": Control.PILOT, "mode": "POSCTL"}
    run = Run(memory(Phase.TIP_HOLD, control=Control.PILOT), parameters)
    run.cycles(hovering(**pilot), 0.2)
    there = add(PLACE, flown)
    moved = hovering(position_w=there, attitude_wb=(math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)))
    run.state = dataclasses.replace(run.state, vigil=Vigil())  # flown, and no jump
    run.cycles(vehicle(**pilot)(moved), 0.2)
    run.cycle(moved)
    first = run.said[-1].setpoint
    assert first is not None
    assert math.dist(first.position_w, there) < 1e-3
    assert first.yaw == pytest.approx(yaw)
    run.cycles(moved, 2.0)
    last = run.said[-1].setpoint
    assert last is not None
    near = norm(flown) < 0.1 and yaw == 0.0
    assert math.dist(last.position_w, PLACE if near else there) < 2e-3


def test_a_tip_that_the_mechanics_lose_is_not_at_its_point(parameters: Parameters, hovering: Hovering) -> None:
    run = Run(memory(Phase.TIP_MOVE), parameters)
    reach, nowhere = run.state.reach, (math.nan, math.nan, math.nan)
    run.cycles(hovering(), 0.05)
    known = run.state
    assert reach is not None
    assert known.prediction is not None
    lost = dataclasses.replace(
        known,
        prediction=dataclasses.replace(known.prediction, tip_a=nowhere),
    )
    for unknown, told in ((0.0, 1e-3), (0.6, math.inf)):
        state = dataclasses.replace(
            lost, reach=dataclasses.replace(reach, error_m=1e-3, within_s=0.3, unknown_s=unknown)
        )
        after = move(Situation(state, hovering(), state.t + 0.01, parameters)).reach
        assert after is not None
        assert (after.within_s, after.error_m) == (0.0, told)
