"""Drawn worlds: what differs, that it is repeatable, how outcomes are counted, and one short run through processes."""

import json
import math
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path
from statistics import NormalDist
from typing import Any, Self

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.__main__ import main
from arm_companion.arm.parameters import ArmParameters
from arm_companion.config import load
from arm_companion.errors import ModelError
from arm_companion.sim import trials
from arm_companion.sim.judges import SCENARIOS
from arm_companion.sim.plant import Plant
from arm_companion.sim.trials import MODEL_ERROR, Outcome, Summary, draw, kind, wilson
from arm_companion.sim.world import World

CONFIG = load("sim.toml")
GRASP = load("sim_grasp.toml")


@given(st.integers(0, 10_000))
def test_the_plant_differs_within_the_model_error_and_the_controller_does_not_know(seed: int) -> None:
    drawn = draw(CONFIG, seed)
    assert drawn.controller.arm == CONFIG.arm
    assert drawn.controller.vehicle == CONFIG.vehicle
    ours, theirs = ArmParameters.of(drawn.controller.arm), ArmParameters.of(drawn.world.arm)
    pairs = [
        (ours.EI, theirs.EI),
        (CONFIG.vehicle.mass_kg, drawn.world.vehicle.mass_kg),
        (CONFIG.sim.bar.friction, drawn.world.sim.bar.friction),
        (CONFIG.arm.mass.disk_kg, drawn.world.arm.mass.disk_kg),
        *zip(ours.k_T.tolist(), theirs.k_T.tolist(), strict=True),
    ]
    for own, other in pairs:
        assert abs(other / own - 1.0) <= MODEL_ERROR + 1e-9
    told, there = drawn.controller.perch.bar_position_m, drawn.world.sim.bar.position_m
    assert max(abs(a - b) for a, b in zip(told, there, strict=True)) <= 0.010 + 1e-9
    assert math.hypot(*drawn.world.sim.wind_m_per_s) <= 2.0
    assert drawn == draw(CONFIG, seed)


@given(st.integers(0, 10_000))
def test_an_object_is_drawn_too_and_told_with_an_error(seed: int) -> None:
    drawn = draw(GRASP, seed)
    thing, told = drawn.world.sim.object, drawn.controller.grasp
    assert drawn.controller.sim.object == thing
    assert 0.15 <= thing.mass_kg <= 0.3
    assert abs(thing.friction / GRASP.sim.object.friction - 1.0) <= MODEL_ERROR
    assert f"friction {100 * (thing.friction / GRASP.sim.object.friction - 1):+.0f} %" in drawn.words
    errors = [a - b for a, b in zip(told.object_position_m, thing.position_m, strict=True)]
    assert max(map(abs, errors)) <= 0.010 + 1e-9
    assert abs(told.object_axis_deg - thing.axis_deg) <= 2.0
    assert draw(CONFIG, seed).world.sim.object == CONFIG.sim.object, "where there is none, none is drawn"


def test_seeds_differ_and_the_plant_takes_its_own_values() -> None:
    one, other = draw(CONFIG, 1), draw(CONFIG, 2)
    assert one.world != other.world
    nominal, drawn = World(CONFIG).plant, World(one.world).plant
    share = one.world.arm.backbone.youngs_modulus_pa / CONFIG.arm.backbone.youngs_modulus_pa
    bending = [joint for joint in range(nominal._model.njnt) if nominal._model.jnt_stiffness[joint] > 0.0]
    assert bending
    for joint in bending:
        assert drawn._model.jnt_stiffness[joint] == pytest.approx(share * nominal._model.jnt_stiffness[joint], rel=1e-3)
    assert drawn._model.body_mass.sum() / nominal._model.body_mass.sum() == pytest.approx(
        one.world.vehicle.mass_kg / CONFIG.vehicle.mass_kg, rel=1e-3
    )


@given(st.integers(0, 200), st.integers(1, 200))
def test_wilsons_interval_solves_its_own_equation(successes: int, trials_: int) -> None:
    """Its ends are the shares p with |k/n - p| = z sqrt(p (1 - p) / n)."""
    successes = min(successes, trials_)
    z = NormalDist().inv_cdf(0.975)
    low, high = wilson(successes, trials_)
    share = successes / trials_
    assert 0.0 <= low <= share + 1e-12
    assert share - 1e-12 <= high <= 1.0
    for end in (low, high):
        assert abs(share - end) == pytest.approx(z * math.sqrt(end * (1.0 - end) / trials_), abs=1e-6)


def test_wilsons_interval_of_95_in_100_is_the_textbooks() -> None:
    assert wilson(95, 100) == pytest.approx((0.8882, 0.9785), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError, match="3 successes of 2"):
        wilson(3, 2)


def test_reasons_that_differ_in_figures_alone_are_counted_together() -> None:
    summary = Summary(
        (
            Outcome(1, True, "", "", ""),
            Outcome(2, False, "grip lost: vehicle moved 0.13 m", "", ""),
            Outcome(3, False, "grip lost: vehicle moved 0.21 m", "the vehicle did not land", ""),
            Outcome(4, False, "never perched", "", ""),
        )
    )
    assert summary.failures == {kind("grip lost: vehicle moved 0.13 m"): 2, "never perched": 1}
    assert (summary.success, summary.harmed) == (1, 1)


class Pool:
    """Processes that fly nothing: outcomes by seed."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, _: Any, __: str, ___: tuple[str, ...], seed: int, scenario: str) -> "Future[Outcome]":
        assert scenario in SCENARIOS
        future: Future[Outcome] = Future()
        good = seed != 8
        future.set_result(Outcome(seed, good, "" if good else "no contact 6 cm past it", "", f"drawn for {scenario}"))
        return future


@pytest.mark.parametrize("scenario", ["perch", "hang", "grasp"])
@pytest.mark.parametrize(("seed", "code"), [(1, 0), (7, 1)])
def test_the_command_line_prints_the_contract_and_says_by_its_exit_code_whether_all_succeeded(
    seed: int, code: int, scenario: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trials, "ProcessPoolExecutor", Pool)
    words = ["sim", scenario, "--simulated", "--trials", "4", "--jobs", "2", "--seed", str(seed), "--json"]
    assert main(words) == code
    out, err = capsys.readouterr()
    last = json.loads(out.splitlines()[-1])
    assert (last["scenario"], last["success"], last["trials"]) == (scenario, 4 - code, 4)
    assert f"drawn for {scenario}" in err
    assert sum(last["failures"].values()) == code
    assert last["interval_95"][0] < last["success"] / 4 <= last["interval_95"][1]
    assert "Wilson" in err


@pytest.mark.parametrize("words", [["sim", "perch", "--trials", "3"], ["sim", "world", "--simulated", "--trials", "3"]])
def test_trials_without_simulated_time_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert "--simulated" in capsys.readouterr().err


@pytest.mark.parametrize("number", ["0", "-2", "many"])
def test_a_number_of_trials_that_is_none_is_refused(number: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["sim", "perch", "--simulated", "--trials", number])
    assert refused.value.code == 2
    assert "--trials" in capsys.readouterr().err


def test_what_a_process_raises_is_seen_here() -> None:
    """Two processes that fail at once: what they raise is seen here, and no process is left behind."""
    with pytest.raises(Exception, match="no_such_key"):
        trials.fly("sim.toml", ["sim.no_such_key=1"], range(2), 2)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ModelError("the plant diverged at 3.120 s"), "the plant diverged at 3.120 s"),
        (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero (arm_companion.sim.world:"),
    ],
)
def test_a_world_whose_flight_raises_has_failed_for_that_reason(
    error: Exception, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverge(*_: Any) -> None:
        raise error

    monkeypatch.setattr(Plant, "step", diverge)
    outcome = trials.fly_one("sim.toml", (), 3)
    assert (outcome.seed, outcome.success, outcome.harm) == (3, False, "")
    assert outcome.reason.startswith(reason)
    assert outcome.words == draw(CONFIG, 3).words


def test_sigterm_ends_the_processes_that_fly_too(tmp_path: Path) -> None:
    words = ["sim", "perch", "--simulated", "--trials", "4", "--jobs", "2", "--output", str(tmp_path)]
    process = subprocess.Popen([sys.executable, "-m", "arm_companion", *words], stderr=subprocess.PIPE, text=True)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    until = time.monotonic() + 60.0
    while len(flying := children.read_text(encoding="ascii").split()) < 3 and time.monotonic() < until:
        time.sleep(0.05)  # two that fly, and what tracks their resources
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20.0)
    assert process.returncode == 128 + signal.SIGTERM
    assert len(flying) == 3
    while any(Path(f"/proc/{child}").exists() for child in flying) and time.monotonic() < until:
        time.sleep(0.05)
    assert not [child for child in flying if Path(f"/proc/{child}").exists()]
