"""Whole flights in simulated time: plant, autopilot stand-in, servos and daemon, joined by bytes alone."""

import atexit
import base64
import functools
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.mission.state import State
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.record.reader import Item, Reader
from arm_companion.record.replay import replay
from arm_companion.record.shares import share, stretches
from arm_companion.record.topics import COMMANDS, FACTS, LOG, RAW, STATE, TRANSITIONS
from arm_companion.record_codec import dumps, loads
from arm_companion.sim.asked import asked
from arm_companion.sim.runner import Result, fly_simulated
from arm_companion.sim.trials import draw
from arm_companion.sim.verdict import Verdict, judge
from arm_companion.sim.world import World

CONFIG = load("sim.toml")


def fly(
    prepare: Callable[[World], None] = lambda _: None, settings: tuple[str, ...] = (), record: Path | None = None
) -> tuple[Result, Verdict]:
    config = load("sim.toml", settings)
    result = run_simulated(fly_simulated(config, lambda _: None, prepare, record))
    return result, judge(result.flight, result.failure)


@functools.cache
def perch() -> tuple[Result, Verdict]:
    """The undisturbed flight, flown once for all who look at it."""
    return fly(record=log())


@functools.cache
def log() -> Path:
    """Where its record is."""
    directory = Path(tempfile.mkdtemp(prefix="arm-companion-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    return directory / "record.mcap"


def phases(result: Result) -> list[str]:
    seen = [record.state.phase.name for record in result.records]
    return [name for i, name in enumerate(seen) if i == 0 or seen[i - 1] != name]


def test_a_perch_goes_through_every_phase_and_lets_go() -> None:
    result, verdict = perch()
    assert verdict.success, verdict.reason
    passed = iter(phases(result))
    wanted = (
        "STOWED",
        "READY",
        "APPROACH",
        "REACH",
        "CONTACT",
        "WRAP",
        "VERIFY",
        "PERCHED",
        "UNLOAD",
        "RELEASE",
        "DEPART",
    )
    assert all(name in passed for name in (*wanted, "STOWED"))


def test_the_perch_is_held_by_contact_in_the_plant_and_within_all_limits() -> None:
    result, verdict = perch()
    assert verdict.wrap_rad > 3.0
    assert verdict.contact_force_n[0] > 1.0
    assert max(max(s.truth.tension) for s in result.flight.samples) < CONFIG.limits.tension_max_n
    assert not any(s.truth.body_contact for s in result.flight.samples if s.state.position_w[2] < -0.5)


def test_load_and_statics_agree_all_along_the_undisturbed_flight() -> None:
    result, _ = perch()
    assert not any(suspect.fault for record in result.records[::20] for suspect in record.state.watch)


def test_load_and_statics_together_know_the_free_arms_tensions_better_than_loads_alone() -> None:
    """Against the plant's truth, while the arm hangs ready: the loads alone are off by the friction of the gears."""
    result, _ = perch()
    ready = [r for r in result.records if r.state.phase.name == "READY"]
    fused, alone = [], []
    for record in ready[::50]:
        truth = result.flight.sample_at(record.t)
        if truth is None:
            continue
        for i, tension in enumerate(truth.truth.tension):
            estimate, tendon = record.commands.tensions[i], record.facts.tendons[i]
            assert abs(estimate.tension - tension) < 4.0 * estimate.sigma
            fused.append((estimate.tension - tension) ** 2)
            alone.append((tendon.tension - tension) ** 2)
    assert sum(fused) < 0.25 * sum(alone)


def test_the_anchored_vehicle_goes_where_it_is_pulled() -> None:
    _, verdict = perch()
    pull = {move.name: move for move in verdict.moves}
    assert pull["pull x"].made_m == pytest.approx(0.010, abs=0.004)
    assert verdict.hover_error_m < 0.005


def test_compensation_makes_the_move_that_the_vehicle_alone_does_not() -> None:
    """Both in one flight: what is asked for stays off by less than a third of what it is off by without."""
    _, verdict = perch()
    pull = {move.name: move for move in verdict.moves}
    assert pull["pull x"].error_m < 0.3 * pull["pull x, not compensated"].error_m
    assert pull["pull x, not compensated"].made_m < 0.005


def test_a_vehicle_that_is_let_go_stays_where_it_is_asked_to_be() -> None:
    _, verdict = perch()
    assert 0.001 < verdict.excursion_m < 0.15


def test_where_the_vehicle_was_asked_to_be_can_be_read_from_the_record() -> None:
    """As in real time, where the daemon is another process."""
    result, _ = perch()
    assert asked(log()) == result.flight.asked
    assert asked(log().with_name("nothing.mcap")) == []


def test_the_predicted_wrench_is_the_plants() -> None:
    _, verdict = perch()
    error = {wrench.span: wrench for wrench in verdict.wrench}
    assert error["free"].force_error_n < 0.15 * error["free"].true_force_n
    assert error["perched"].force_error_n < 0.35 * error["perched"].true_force_n
    assert error["perched"].covered > 0.9


def test_no_cycle_is_missed_and_replay_gives_the_same_commands_bit_for_bit() -> None:
    result, _ = perch()
    assert result.missed == 0
    reader = Reader(log())
    outcome = replay(reader)
    assert outcome.identical, outcome.first
    assert outcome.cycles == len(result.records)
    assert not outcome.remarks
    assert not outcome.gaps
    parts = [share(log(), "", stretch) for stretch in stretches(outcome.cycles, 3)]
    assert None not in parts, "from where the solver's starts are recorded it comes out the same"
    assert min(part.cycles for part in parts if part) > 0.2 * outcome.cycles
    assert sum(part.cycles for part in parts if part) == outcome.cycles


def test_the_record_has_every_cycle_every_frame_and_every_sentence() -> None:
    result, _ = perch()
    found: dict[str, list[Item]] = {}
    for item in Reader(log()):
        found.setdefault(item.topic, []).append(item)
    assert len(found[FACTS]) == len(found[STATE]) == len(found[COMMANDS]) == len(result.records)
    for record, item in zip(result.records[::500], found[STATE][::500], strict=True):
        assert dumps(loads(State, item.data)) == dumps(record.state)
    passed = [json.loads(item.data)["after"] for item in found[TRANSITIONS]]
    assert passed == [phase for phase in phases(result) if phase != "STARTUP"]
    said = [json.loads(item.data)["message"] for item in found[LOG]]
    assert {notice.text for record in result.records for notice in record.commands.notices} <= set(said)
    for pipe in ("servos", "mavlink/autopilot", "mavlink/ground"):
        assert len(found[f"{RAW}{pipe}/sent"]) > 100, pipe
    codec = MavlinkCodec(255, 190)
    received = [json.loads(item.data)["data"] for item in found[f"{RAW}mavlink/autopilot/received"]]
    heard = [m for data in received for m in codec.feed(base64.b64decode(data))]
    assert {"HEARTBEAT", "ATTITUDE_QUATERNION"} <= {message.get_type() for message in heard}


@pytest.mark.scenario
def test_the_mount_stays_clear_of_the_bar_as_the_arm_opens_in_wind() -> None:
    """Half a millimetre was left and then nothing: the vehicle sank by the arm's weight, beside a bar 6 mm away."""
    drawn = draw(load("sim.toml", ("sim.seed=500",)), 5102)
    result = run_simulated(fly_simulated(drawn.controller, lambda _: None, world=drawn.world))
    verdict = judge(result.flight, result.failure)
    assert verdict.success, verdict.reason


@pytest.mark.scenario
def test_a_bar_ten_centimetres_out_of_reach_is_reported_and_the_vehicle_comes_home() -> None:
    def away(world: World) -> None:
        x, y, z = CONFIG.sim.bar.position_m
        world.plant.move_bar((x + 0.10, y, z))

    result, verdict = fly(away)
    assert not verdict.success
    assert "no contact" in verdict.reason or "never perched" in verdict.reason
    assert "PERCHED" not in phases(result)
    assert phases(result)[-3:] == ["DEPART", "STOWING", "STOWED"]
    assert "did not land" not in verdict.reason
    assert not any(s.truth.body_contact for s in result.flight.samples if s.state.position_w[2] < -0.5)


@pytest.mark.scenario
def test_on_a_position_that_wanders_as_on_satellites_the_move_is_made_though_the_mechanics_fail() -> None:
    """As seen on both real flight stacks (docs/adr/0029): the arm that the daemon believes in has no equilibrium."""
    result, verdict = fly(settings=("sim.position_wander_m=0.02",))
    assert verdict.success, verdict.reason
    assert any("no solution" in text for _, text in result.flight.texts)
    pull = {move.name: move for move in verdict.moves}
    assert pull["pull x"].error_m < pull["pull x, not compensated"].error_m
    assert verdict.excursion_m < 0.3


@pytest.mark.scenario
def test_the_pilot_takes_the_vehicle_while_it_is_perched_and_the_arm_holds() -> None:
    def take(world: World) -> None:
        world.at(60.0, lambda w: w.autopilot.take_over("POSCTL"))

    result, verdict = fly(take)
    assert not verdict.success
    after = [r for r in result.records if r.state.phase.name == "HOLDING"]
    assert after, phases(result)
    assert all(r.commands.setpoint is None for r in after)
    taken = next(
        i for i, r in enumerate(result.records) if r.state.phase.name == "PERCHED" and r.facts.vehicle.mode == "POSCTL"
    )
    assert all(r.commands.setpoint is None for r in result.records[taken : taken + 300])


@pytest.mark.scenario
def test_a_dead_servo_during_the_approach_ends_it_and_the_vehicle_comes_home() -> None:
    def kill(world: World) -> None:
        def silence(w: World) -> None:
            w.servos[2].silenced = True

        world.at(20.0, silence)

    result, verdict = fly(kill)
    assert not verdict.success
    assert "tendon 2" in " ".join(text for _, text in result.flight.texts)
    assert "PERCHED" not in phases(result)
    assert "did not land" not in verdict.reason


@pytest.mark.scenario
def test_a_tendon_that_is_cut_is_found_when_the_arm_bends_and_the_perch_given_up() -> None:
    result, verdict = fly(lambda world: world.at(20.0, lambda w: w.plant.cut_tendon(0)))
    assert not verdict.success
    assert "PERCHED" not in phases(result)
    assert "tendon 1 broken" in "".join(text for _, text in result.flight.texts)
    assert phases(result)[-5:] == ["UNLOAD", "RELEASE", "DEPART", "STOWING", "STOWED"]
    assert "did not land" not in verdict.reason
    found = next(record for record in result.records if any(w.broken for w in record.state.watch))
    assert found.state.phase.name in {"WRAP", "UNLOAD"}


@pytest.mark.scenario
def test_the_same_seed_gives_the_same_flight_and_another_seed_another() -> None:
    def short(seed: int) -> list[str]:
        def end_soon(world: World) -> None:
            world.at(9.0, lambda w: w.autopilot.fail())

        config = load("sim.toml", (f"sim.seed={seed}",))
        result = run_simulated(fly_simulated(config, lambda _: None, end_soon))
        return [dumps(record) for record in result.records[:2000]]

    first = short(1)
    assert first == short(1)
    assert first != short(2)
