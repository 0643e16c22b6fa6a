"""The hang perch in steps: weight to the arm and back, and an arm that opens for nobody while it carries."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.reaction import GRAVITY
from arm_companion.arm.rod_model import RodModel
from arm_companion.config import load
from arm_companion.mission.facts import ArmFault, Control, Facts, Order, Result
from arm_companion.mission.facts import Bar as ToldBar
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.payload import ThrustCurve
from arm_companion.mission.sharing import SUSPENDED
from arm_companion.mission.state import PerchKind, Phase, Sharing, State
from tests.unit.conftest import HOVER, tendons
from tests.unit.mission_rig import ANCHOR, DT, PLACE, T0, Run, ask, memory, tendon, vehicle

HOVER_THROTTLE = 0.5
SPRING_M = 0.03  # by which the arm gives under the whole weight
BENT = (5.5, 0.0)


@pytest.fixture(scope="module")
def above() -> Parameters:
    config = load("sim_hang.toml")
    slow = dataclasses.replace(config.rates, wrench_hz=5.0)
    return Parameters(dataclasses.replace(config, rates=slow), RodModel(ArmParameters.of(config.arm)))


@pytest.fixture(scope="module")
def wrapped(above: Parameters) -> Facts:
    """An arm at its wrap, and a vehicle that hovers under the bar."""
    pulls = above.model.pull_for_bend(np.asarray(BENT))
    hovering = dataclasses.replace(HOVER, position_w=PLACE)
    return Facts(hovering, tendons(tuple(map(float, pulls)), (30.0, 11.0, 1.0, 11.0)))


class Bar:
    """A vehicle on a bar by a spring: motors that do what the set-point's acceleration says, as PX4's do."""

    def __init__(self, run: Run, facts: Facts, holds: float = 1.0) -> None:
        self.run, self.facts, self.holds = run, facts, holds
        self.throttle = HOVER_THROTTLE

    def cycle(self, facts: Facts | None = None, **fields: object) -> None:
        setpoint = self.run.said[-1].setpoint if self.run.said else None
        if setpoint is not None:
            self.throttle = HOVER_THROTTLE * (1.0 - setpoint.acceleration_w[2] / GRAVITY)
        x, y, z = PLACE
        sunk = SPRING_M * (1.0 - self.throttle / HOVER_THROTTLE) * self.holds
        known: dict[str, object] = {"position_w": (x, y, z + sunk), "throttle": self.throttle}
        self.run.cycle(vehicle(**{**known, **fields})(facts or self.facts))

    def until(self, phase: Phase, seconds: float, **fields: object) -> None:
        for _ in range(round(seconds / DT)):
            self.cycle(**fields)
            if self.run.state.phase is phase:
                return
        raise AssertionError(f"{self.run.phases} without {phase.name} within {seconds} s: {self.run.texts}")

    def order(self, order: Order, *values: float, **fields: object) -> tuple[Result, str]:
        self.cycle(ask(self.facts, order, *values), **fields)
        answer = self.run.said[-1].answers[-1]
        return answer.result, answer.reason


def verified(**fields: object) -> State:
    """Memory at the end of a good pull test of a hang perch."""
    known: dict[str, object] = {
        "since": T0 - 3.5,
        "kind": PerchKind.HANG,
        "sharing": Sharing(hover=HOVER_THROTTLE),
        "bend": BENT,
        "bend_goal": BENT,
        "anchor": dataclasses.replace(ANCHOR, position_w=PLACE),
        "contact_w": (1.9, 0.0, -2.26),
    }
    return memory(Phase.VERIFY, **{**known, **fields})


@pytest.fixture(scope="module")
def transferred(above: Parameters, wrapped: Facts) -> Bar:
    """A transfer of the load from its begin to its end, made once."""
    bar = Bar(Run(verified(), above), wrapped)
    bar.until(Phase.HANGING, 30.0)
    return bar


@pytest.fixture
def hanging(transferred: Bar) -> Bar:
    """A vehicle that has just come to hang."""
    run = Run(transferred.run.state, transferred.run.parameters, said=[transferred.run.said[-1]])
    bar = Bar(run, transferred.facts)
    bar.throttle = transferred.throttle
    return bar


def test_the_thrust_goes_down_in_steps_that_each_wait_for_rest_until_the_vehicle_hangs(
    above: Parameters, transferred: Bar
) -> None:
    bar, run = transferred, transferred.run
    assert run.phases == [Phase.VERIFY, Phase.LOAD_TRANSFER, Phase.HANGING]
    asked = [said.setpoint.acceleration_w[2] for said in run.said if said.setpoint is not None]
    stood = [round(a / GRAVITY, 2) for a, b in zip(asked, asked[80:], strict=False) if abs(a - b) < 0.02]
    stride = (1.0 - above.config.hang.idle_share) / above.config.hang.steps
    for step in range(1, above.config.hang.steps):
        assert any(abs(level - step * stride) < 0.03 for level in stood), f"no rest at step {step}"
    assert bar.throttle == pytest.approx(above.config.hang.idle_share * HOVER_THROTTLE, abs=0.01)
    for said in run.said[1:]:
        assert said.setpoint is not None
        assert math.dist(said.setpoint.position_w, PLACE) < 2.0 * SPRING_M, "the reference stays with the vehicle"


def test_a_vehicle_that_does_not_come_to_rest_is_not_unloaded_further(above: Parameters, wrapped: Facts) -> None:
    bar = Bar(Run(verified(), above), wrapped)
    x, y, z = PLACE
    for i in range(2000):
        bar.cycle(position_w=(x + 0.05 * math.sin(0.016 * i), y, z))
    first = 1.0 - (1.0 - above.config.hang.idle_share) / above.config.hang.steps
    assert bar.run.state.sharing.share >= first - 1e-9
    assert bar.run.state.phase is Phase.LOAD_TRANSFER


def test_a_bar_that_is_told_meanwhile_turns_no_swinging_into_a_slip(hanging: Bar) -> None:
    bar, run = hanging, hanging.run
    x, y, z = PLACE
    z += SPRING_M * (1.0 - bar.throttle / HOVER_THROTTLE)
    anchor = run.state.anchor
    assert anchor is not None
    run.state = dataclasses.replace(run.state, anchor=dataclasses.replace(anchor, bar_axis_w=(0.0, 1.0, 0.0)))
    along_swing = dataclasses.replace(bar.facts, bar=ToldBar((9.0, 0.0, -2.5), (1.0, 0.0, 0.0), 0.02), bar_age_s=0.1)
    for i in range(300):
        bar.cycle(along_swing, position_w=(x + 0.08 * math.sin(0.04 * i), y, z))
    assert run.state.phase is Phase.HANGING
    bar.cycle(along_swing, position_w=(x, y + 0.15, z))
    bar.until(Phase.TAKE_BACK, 1.0, position_w=(x, y + 0.15, z))


@pytest.mark.parametrize("phase", [Phase.LOAD_TRANSFER, Phase.HANGING])
def test_a_slip_brings_the_motors_up_at_once_and_then_the_arm_lets_go(
    phase: Phase, above: Parameters, wrapped: Facts
) -> None:
    bar = Bar(Run(verified(), above), wrapped)
    bar.until(phase, 30.0)
    x, y, z = PLACE
    for _ in range(3):
        bar.cycle(velocity_w=(0.0, 0.0, 0.4), position_w=(x, y, z + 0.05))
    assert bar.run.state.phase is Phase.TAKE_BACK
    assert bar.run.state.errors & ArmFault.SLIP
    bar.until(Phase.UNLOAD, 3.0)
    assert bar.throttle == pytest.approx(HOVER_THROTTLE)


def test_released_from_hanging_the_motors_take_the_load_in_steps_before_the_arm_moves(hanging: Bar) -> None:
    bar = hanging
    assert bar.order(Order.RELEASE)[0] is Result.IN_PROGRESS
    began = len(bar.run.said)
    bar.until(Phase.UNLOAD, 30.0)
    assert all(said.pulls is None for said in bar.run.said[began:-1])
    assert bar.throttle == pytest.approx(HOVER_THROTTLE)
    assert bar.run.said[-1].setpoint is not None
    assert bar.run.said[-1].setpoint.acceleration_w == (0.0, 0.0, 0.0)
    bar.until(Phase.RELEASE, 15.0)
    last = bar.run.said[-1].setpoint
    assert last is not None
    assert last.position_w[2] > PLACE[2] + 0.01, "from below the grip, so that the mount stays clear of the bar"


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_motors_that_do_not_come_up_do_not_open_the_arm(share: float, hanging: Bar, wrapped: Facts) -> None:
    bar = hanging
    bar.order(Order.RELEASE)
    for _ in range(700):
        x, y, z = PLACE
        sunk = vehicle(throttle=share * HOVER_THROTTLE, position_w=(x, y, z + SPRING_M))(wrapped)
        bar.run.cycle(sunk, 0.1)
    assert bar.run.state.phase is Phase.HANG_HOLD
    assert bar.run.state.errors & ArmFault.TIMEOUT
    assert set(bar.run.phases) <= SUSPENDED


def test_the_pilot_takes_it_while_it_hangs_and_lifts_it_off_himself(hanging: Bar) -> None:
    bar = hanging
    pilot: dict[str, object] = {"control": Control.PILOT, "mode": "POSCTL"}
    bar.cycle(None, **pilot)
    assert bar.run.said[-1].setpoint is None
    assert bar.run.state.phase is Phase.HANG_HOLD
    bar.throttle = 0.3 * HOVER_THROTTLE
    assert bar.order(Order.RELEASE, **pilot)[0] is Result.IN_PROGRESS
    for _ in range(500):
        bar.cycle(None, **pilot)
    assert bar.run.state.phase is Phase.TAKE_BACK, "his motors do not carry it yet"
    bar.throttle = HOVER_THROTTLE
    bar.until(Phase.RELEASE, 5.0, **pilot)
    assert all(said.setpoint is None for said in bar.run.said[-500:])


def leaving(phase: Phase, bend: tuple[float, float] = BENT, **fields: object) -> State:
    """Memory of a hung vehicle whose load has just been taken back."""
    sharing = Sharing(hover=HOVER_THROTTLE, place=PLACE, first=PLACE[2])
    goal = (0.0, 0.0) if phase is Phase.RELEASE else bend
    known = {"kind": PerchKind.HANG, "bend": bend, "bend_goal": goal, "sharing": sharing, "rest": PLACE}
    return memory(phase, **{**known, **fields})


@pytest.mark.parametrize("control", [Control.PILOT, Control.FAILSAFE])
def test_a_vehicle_taken_from_us_before_the_arm_opens_is_held_again(
    control: Control, above: Parameters, wrapped: Facts
) -> None:
    run = Run(leaving(Phase.UNLOAD), above)
    run.cycles(wrapped, 0.1)
    run.cycles(vehicle(control=control, mode="STABILIZED", throttle=0.0)(wrapped), 3.0)
    assert run.phases == [Phase.UNLOAD, Phase.HOLDING, Phase.HANG_HOLD]
    assert all(said.pulls is None for said in run.said[10:])


@pytest.mark.parametrize("control", [Control.PILOT, Control.EXTERNAL])
@pytest.mark.parametrize("phase", [Phase.UNLOAD, Phase.RELEASE])
def test_motors_that_drop_before_the_arm_has_opened_have_it_hold_again(
    phase: Phase, control: Control, above: Parameters, wrapped: Facts
) -> None:
    flown = vehicle(control=control, mode="STABILIZED")(wrapped)
    run = Run(leaving(phase, control=control), above)
    run.cycles(flown, 0.2)
    run.cycles(vehicle(throttle=0.6 * HOVER_THROTTLE)(flown), 0.1)
    run.cycles(flown, 0.1)
    assert run.phases == [phase], "a manoeuvre"
    run.cycles(vehicle(throttle=0.6 * HOVER_THROTTLE)(flown), 0.3)
    assert run.phases == [phase, Phase.HOLDING, Phase.HANG_HOLD]


def test_motors_that_nobody_knows_the_hover_of_drop_when_they_idle(above: Parameters, wrapped: Facts) -> None:
    for throttle, phases in ((0.3, [Phase.UNLOAD]), (0.1, [Phase.UNLOAD, Phase.HOLDING, Phase.HANG_HOLD])):
        run = Run(leaving(Phase.UNLOAD, control=Control.PILOT, sharing=Sharing()), above)
        run.cycles(vehicle(control=Control.PILOT, throttle=throttle)(wrapped), 0.5)
        assert run.phases == phases


def test_an_arm_that_is_half_open_goes_on_opening(above: Parameters, wrapped: Facts) -> None:
    run = Run(leaving(Phase.RELEASE, bend=(2.0, 0.0)), above)
    run.cycles(vehicle(throttle=0.1)(wrapped), 0.5)
    assert run.phases == [Phase.RELEASE]


@pytest.mark.parametrize(
    "order", [Order.RELEASE, Order.STOW, Order.ABORT, Order.READY, Order.PERCH, Order.CLEAR_ERRORS]
)
def test_no_order_opens_an_arm_over_motors_that_stand(order: Order, hanging: Bar) -> None:
    bar = hanging
    bar.cycle(armed=False, landed=True)
    assert bar.run.state.phase is Phase.HANG_HOLD
    result, reason = bar.order(order, armed=False, landed=True)
    for _ in range(300):
        bar.cycle(armed=False, landed=True)
    assert bar.run.state.phase is Phase.HANG_HOLD
    assert all(said.pulls is None for said in bar.run.said[-300:])
    if order is Order.RELEASE:
        assert result is Result.TEMPORARILY_REJECTED
        assert "arm it first" in reason


def test_disarmed_while_it_hangs_it_is_armed_again_by_a_person_and_leaves(hanging: Bar) -> None:
    bar = hanging
    for _ in range(100):
        bar.cycle(armed=False, landed=True, control=Control.PILOT)
    assert any("hang by the arm" in text for text in bar.run.texts)
    armed: dict[str, object] = {"landed": True, "control": Control.PILOT, "throttle": 0.0}
    bar.cycle(None, **armed)
    assert bar.run.said[-1].setpoint is None, "nobody has given the vehicle back"
    assert bar.order(Order.READY, **armed)[0] is Result.ACCEPTED
    bar.cycle(None, **armed)
    assert bar.run.said[-1].setpoint is not None, "PX4 takes the switch only with a stream"
    armed["control"] = Control.EXTERNAL
    assert bar.order(Order.RELEASE, **armed)[0] is Result.IN_PROGRESS
    bar.cycle(None, **armed)
    up = bar.run.said[-1].setpoint
    assert up is not None
    assert up.position_w[2] < PLACE[2] - 0.2, "an autopilot that thinks it stands takes off to a set-point above"
    bar.throttle = HOVER_THROTTLE
    bar.until(Phase.RELEASE, 10.0)


def test_an_arm_above_that_is_found_bent_may_carry_the_vehicle(above: Parameters, wrapped: Facts) -> None:
    run = Run(State(t=T0), above)
    grounded = vehicle(armed=False, landed=True)(wrapped)
    run.cycles(grounded, 0.03)
    assert run.phases == [Phase.STARTUP, Phase.HOLDING, Phase.HANG_HOLD]
    commands = run.cycle(ask(grounded, Order.RELEASE))
    assert commands.answers[0].result is Result.TEMPORARILY_REJECTED
    # nobody knows its hover's throttle, so it has to rise
    run.cycles(ask(wrapped, Order.READY), 0.05)
    run.cycles(ask(wrapped, Order.RELEASE), 6.0)
    assert run.state.phase is Phase.TAKE_BACK
    x, y, z = PLACE
    for i in range(300):
        run.cycle(vehicle(position_w=(x, y, z - min(0.0005 * i, 0.06)))(wrapped))
    assert run.state.phase in (Phase.UNLOAD, Phase.RELEASE)
    run.cycles(vehicle(position_w=(x, y, z - 0.06))(wrapped), 1.5)
    last = run.said[-1].setpoint
    assert last is not None
    assert math.dist(last.position_w, PLACE) < 0.2, "where the bar was met it does not know, so it stays"


def test_no_cycle_lies_between_holding_and_hang_hold_in_which_the_arm_could_be_opened(
    above: Parameters, wrapped: Facts
) -> None:
    run = Run(memory(Phase.HOLDING, bend=BENT), above)
    commands = run.cycle(ask(vehicle(armed=False)(wrapped), Order.RELEASE))
    assert commands.answers[0].result is Result.TEMPORARILY_REJECTED
    assert run.state.phase is Phase.HANG_HOLD


@pytest.mark.parametrize(
    ("change", "settings", "words"),
    [
        (vehicle(throttle_age_s=9.0), (), "throttle"),
        (vehicle(), ("limits.wrench_force_n=10.0",), "weight"),
        (vehicle(), ("mount.rpy_deg=[0.0, 0.0, 0.0]", "limits.keep_out.half_angle_deg=0.0"), "not above"),
    ],
)
def test_a_hang_perch_is_refused_where_it_cannot_hang_and_an_anchor_perch_is_not(
    change: Callable[[Facts], Facts], settings: tuple[str, ...], words: str, wrapped: Facts
) -> None:
    config = load("sim_hang.toml", settings)
    parameters = Parameters(config, RodModel(ArmParameters.of(config.arm)))
    straight = tendons((0.0, 0.0, 0.0, 0.0), (4.0, 4.0, 4.0, 4.0))
    facts = change(dataclasses.replace(wrapped, tendons=straight))
    run = Run(memory(Phase.READY), parameters)
    answer = run.cycle(ask(facts, Order.PERCH, 1.0)).answers[0]
    assert (answer.result, words in answer.reason) == (Result.TEMPORARILY_REJECTED, True)
    assert run.state.kind is PerchKind.ANCHOR
    assert run.cycle(ask(facts, Order.PERCH, 0.0)).answers[0].result is Result.IN_PROGRESS


@pytest.mark.parametrize("change", [tendon(0, temperature=70.0), tendon(3, voltage=9.7), tendon(1, silent=True)])
def test_while_the_vehicle_is_ours_a_failing_part_brings_the_motors_up_and_else_a_person_is_asked(
    change: Callable[[Facts], Facts], hanging: Bar, wrapped: Facts
) -> None:
    theirs = Bar(Run(hanging.run.state, hanging.run.parameters), wrapped)
    pilot: dict[str, object] = {"control": Control.PILOT, "mode": "POSCTL"}
    theirs.cycle(None, **pilot)
    for _ in range(150):
        hanging.cycle(change(wrapped))
        theirs.cycle(change(wrapped), **pilot)
    assert Phase.TAKE_BACK in hanging.run.phases
    assert theirs.run.state.phase is Phase.HANG_HOLD
    assert any("cannot let go" in text for text in theirs.run.texts)


def test_the_wrench_of_a_hanging_vehicle_is_its_weight_less_what_the_motors_carry(
    above: Parameters, hanging: Bar
) -> None:
    bar = hanging
    for _ in range(50):
        bar.cycle()
    wrench = bar.run.said[-1].wrench
    weight = above.config.vehicle.mass_kg * GRAVITY
    assert wrench.valid
    assert wrench.force_b[2] == pytest.approx(-0.75 * weight, rel=0.06)
    assert wrench.force_sigma[2] < 0.1 * weight


def test_a_bar_of_another_place_is_not_drifted_to_while_the_load_is_taken_back(
    above: Parameters, wrapped: Facts
) -> None:
    far = (2.0, 40.0, -2.2)
    anchor = dataclasses.replace(ANCHOR, position_w=far)
    state = memory(Phase.HANG_HOLD, kind=PerchKind.HANG, bend=BENT, contact_w=far, anchor=anchor, rest=far)
    bar = Bar(Run(state, above), wrapped)
    bar.order(Order.RELEASE)
    bar.until(Phase.RELEASE, 30.0)
    for _ in range(100):
        bar.cycle()
    for said in bar.run.said:
        assert said.setpoint is not None
        assert math.dist(said.setpoint.position_w, PLACE) < 0.2
    assert bar.run.state.contact_w is None


def test_after_a_restart_the_vehicle_is_not_turned_while_the_arm_is_wrapped(above: Parameters, wrapped: Facts) -> None:
    yaw = 0.5 * math.pi
    east = vehicle(attitude_wb=(math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)))(wrapped)
    run = Run(State(t=T0), above)
    run.cycles(east, 0.1)
    run.cycles(ask(east, Order.READY), 0.1)
    run.cycle(ask(east, Order.RELEASE))
    x, y, z = PLACE
    for i in range(400):
        run.cycle(vehicle(position_w=(x, y, z - min(0.0005 * i, 0.06)))(east))
    assert {Phase.UNLOAD, Phase.RELEASE} <= set(run.phases)
    assert all(said.setpoint.yaw == pytest.approx(yaw) for said in run.said if said.setpoint is not None)


@pytest.mark.parametrize(
    ("control", "fields", "opens"),
    [
        (Control.PILOT, {"throttle": 0.05}, False),
        (Control.PILOT, {"throttle": 0.4}, True),
        (Control.PILOT, {"throttle_age_s": 9.0}, False),
        (Control.EXTERNAL, {"throttle": 0.05}, False),
        (Control.EXTERNAL, {"throttle_age_s": 9.0}, True),
    ],
)
def test_a_height_that_drifts_opens_no_arm_over_idle_motors(
    control: Control, fields: dict[str, object], opens: bool, above: Parameters, wrapped: Facts
) -> None:
    flown = vehicle(control=control, mode="STABILIZED", **fields)(wrapped)
    run = Run(State(t=T0), above)
    run.cycles(ask(flown, Order.READY), 0.1)
    run.cycles(ask(flown, Order.READY), 0.1)
    run.cycle(ask(flown, Order.RELEASE))
    x, y, z = PLACE
    for i in range(400):
        run.cycle(vehicle(position_w=(x, y, z - min(0.0005 * i, 0.06)))(flown))
    assert (Phase.UNLOAD in run.phases) is opens


def test_a_vehicle_given_back_without_ready_is_not_flown_by_us_and_does_not_rise_by_drifting(
    above: Parameters, wrapped: Facts
) -> None:
    run = Run(memory(Phase.HANG_HOLD, streaming=False, reference=None, sharing=Sharing(first=PLACE[2])), above)
    quiet = vehicle(throttle_age_s=9.0)(wrapped)
    run.cycle(ask(quiet, Order.RELEASE))
    x, y, z = PLACE
    for i in range(400):
        run.cycle(vehicle(position_w=(x, y, z - min(0.0005 * i, 0.06)))(quiet))
    assert run.phases == [Phase.HANG_HOLD, Phase.TAKE_BACK]


@pytest.mark.parametrize("bent", [0.0, 0.25, 0.4])
def test_the_thrust_of_idling_motors_is_that_of_the_curve_that_they_flew_with(
    above: Parameters, hanging: Bar, bent: float
) -> None:
    """Rotors whose thrust is (1 - c) x + c x^2 lift less at a quarter of their throttle than a quarter."""
    bar, prior = hanging, ThrustCurve.prior(HOVER_THROTTLE)
    slope = (1.0 + bent) * GRAVITY / HOVER_THROTTLE
    curve = dataclasses.replace(
        prior,
        theta=(prior.theta[0], slope, *prior.theta[2:]),
        covariance=(prior.covariance[0], (0.0, (0.1 * slope) ** 2, 0.0, 0.0), *prior.covariance[2:]),
    )
    for _ in range(50):
        bar.run.state = dataclasses.replace(bar.run.state, load=dataclasses.replace(bar.run.state.load, curve=curve))
        bar.cycle()
    wrench, mass = bar.run.said[-1].wrench, above.config.vehicle.mass_kg
    x = bar.throttle / HOVER_THROTTLE
    carried = (mass - above.model.parameters.mass - mass * ((1.0 - bent) * x + bent * x * x)) * GRAVITY
    assert wrench.force_b[2] == pytest.approx(-carried, abs=0.02)
    assert 0.03 * mass * GRAVITY < wrench.force_sigma[2] < 0.06 * mass * GRAVITY


def test_what_idling_motors_twist_while_they_level_is_within_what_is_told(above: Parameters, hanging: Bar) -> None:
    """In the plant they ended with all that they had, 2.7 N at 0.18 m, on one side."""
    for _ in range(50):
        hanging.cycle()
    weight = above.config.vehicle.mass_kg * GRAVITY
    pitch = 0.18 * hanging.throttle / HOVER_THROTTLE * weight
    wrench = hanging.run.said[-1].wrench
    assert wrench.torque_b == (0.0, 0.0, 0.0)
    assert min(wrench.torque_sigma[:2]) > 0.8 * pitch
