"""Fitting a loading test: known parameters come back, intervals cover them, and bad data are refused."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from arm_companion.__main__ import main
from arm_companion.arm import identification as ident
from arm_companion.arm.identification import LoadingTest, NotIdentifiable, Reading
from arm_companion.arm.least_squares import levenberg_marquardt, student
from arm_companion.arm.parameters import ArmParameters, Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.cli.calibrate import drop_in
from arm_companion.config import Config, load
from arm_companion.errors import NoSolution
from arm_companion.experiments import case, loading_csv, stiffness_test

HANGING = np.array((0.0, 0.0, 9.81))
NONE = np.full(3, math.nan)
TRUE = {"EI": 1.15, "k_T": 0.8, "T0": 0.7}


@pytest.fixture(scope="module")
def nominal() -> ArmParameters:
    return case.arm(Config(), Guides.DISKS)


@pytest.fixture(scope="module")
def exact(nominal: ArmParameters) -> tuple[Reading, ...]:
    """What a stiffer, slacker arm would show without noise."""
    model, commanded = RodModel(nominal.scaled(GJ=TRUE["EI"], **TRUE)), RodModel(nominal)
    readings = []
    for theta in (0.0, 45.0):
        pull, last = commanded.pull_for_bend(case.bend(theta)), None
        for force in (0.0, 0.4, 0.8, -0.5):
            last = model.free(pull, HANGING, follower_wrench=(force, 0, 0, 0, 0, 0), start=last)
            follower = np.array((force, 0.0, 0.0))
            readings.append(
                Reading(f"{theta}", pull, np.zeros(3), follower, last.tip_position, NONE, last.tension.copy())
            )
    return tuple(readings)


def noisy(readings: tuple[Reading, ...], seed: int, *, tension: bool = True) -> LoadingTest:
    """With half a millimetre and a tenth of a newton of noise."""
    rng = np.random.default_rng(seed)
    return LoadingTest(
        tuple(
            Reading(
                r.run,
                r.pull,
                r.force,
                r.follower,
                r.position + 5e-4 * rng.normal(size=3),
                NONE,
                r.tension + 0.1 * rng.normal(size=4) if tension else np.full(4, math.nan),
            )
            for r in readings
        ),
        HANGING,
    )


def truth(nominal: ArmParameters) -> dict[str, float]:
    return {"EI": nominal.EI * TRUE["EI"], "k_T": nominal.k_T[0] * TRUE["k_T"], "T0": nominal.T0[0] * TRUE["T0"]}


# --- the small solver ---


def test_least_squares_finds_a_minimum_and_its_slope() -> None:
    t = np.linspace(0, 2, 20)
    data = 3 * np.exp(-1.3 * t)
    x, r, J = levenberg_marquardt(
        lambda p: p[0] * np.exp(-p[1] * t) - data, np.array((1.0, 0.2)), np.full(2, -9.0), np.full(2, 9.0)
    )
    assert np.allclose(x, (3, 1.3), atol=1e-6)
    assert np.abs(r).max() < 1e-6
    assert np.allclose(J, np.column_stack((np.exp(-1.3 * t), -3 * t * np.exp(-1.3 * t))), atol=5e-3)


def test_least_squares_stops_at_a_bound_and_still_fits_the_rest() -> None:
    x, _, _ = levenberg_marquardt(
        lambda p: np.array((p[0] + 2, p[0] + p[1] - 1, p[1] - 3)), np.array((1.0, 0.0)), np.zeros(2), np.full(2, 9.0)
    )
    assert np.allclose(x, (0, 2), atol=1e-6)
    x, _, _ = levenberg_marquardt(lambda p: p - (3, 0.5), np.zeros(2), np.zeros(2), np.ones(2))
    assert np.allclose(x, (1, 0.5), atol=1e-6)


def test_least_squares_gives_up_rather_than_go_astray() -> None:
    with pytest.raises(NoSolution):
        levenberg_marquardt(lambda p: np.exp(-p), np.array((0.0,)), np.array((-1e9,)), np.array((1e9,)))


@pytest.mark.parametrize("degrees", [3, 5, 10, 40, 400])
@pytest.mark.parametrize("confidence", [0.9, 0.95, 0.99])
def test_students_quantile(degrees: int, confidence: float) -> None:
    assert student(confidence, degrees) == pytest.approx(stats.t.ppf(0.5 + confidence / 2, degrees), rel=0.02)


# --- the fit ---


def test_exact_data_give_the_exact_arm(nominal: ArmParameters, exact: tuple[Reading, ...]) -> None:
    fit = ident.fit(nominal, LoadingTest(exact, HANGING), ("EI", "k_T", "T0"))
    for name, value in truth(nominal).items():
        assert fit.estimates[name].value == pytest.approx(value, rel=1e-4)
    assert fit.scatter[ident.POSITION] < 1e-6
    assert fit.scatter_before[ident.POSITION] > 1e-3
    assert not fit.notes


def test_intervals_cover_and_scatter_is_the_noise(nominal: ArmParameters, exact: tuple[Reading, ...]) -> None:
    inside = trials = 0
    for seed in range(5):
        fit = ident.fit(nominal, noisy(exact, seed), ("EI", "k_T", "T0"))
        assert fit.scatter[ident.POSITION] == pytest.approx(5e-4, rel=0.45)
        assert fit.scatter[ident.TENSION] == pytest.approx(0.1, rel=0.45)
        assert fit.degrees == 8 * 7 - 3
        for name, value in truth(nominal).items():
            e = fit.estimates[name]
            assert abs(e.value / value - 1) < 5 * e.sigma / e.value
            inside += e.lower <= value <= e.upper
            trials += 1
    assert inside >= 12  # of 15 at 95 %: fewer has a chance of 1 in 200


def test_displacements_alone_do(nominal: ArmParameters, exact: tuple[Reading, ...]) -> None:
    first = {r.run: next(o for o in exact if o.run == r.run).position for r in exact}
    shifts = tuple(
        Reading(r.run, r.pull, r.force, r.follower, NONE, r.position - first[r.run], np.full(4, math.nan))
        for r in exact
    )
    fit = ident.fit(nominal, LoadingTest(shifts, HANGING), ("EI",))
    assert len(fit.measured) == 6 * 3  # the first of a run is zero by definition
    assert fit.estimates["EI"].value == pytest.approx(truth(nominal)["EI"], rel=0.02)
    assert not fit.estimates["k_T"].fitted


def test_what_a_test_does_not_tell_stays_as_configured(exact: tuple[Reading, ...]) -> None:
    """Continuous guides, taut tendons, nothing but the tip: pretension shows nowhere."""
    smooth = case.arm(Config())
    model = RodModel(smooth)
    pull = model.pull_for_bend(case.bend(20))
    rng = np.random.default_rng(5)
    readings = tuple(
        Reading(
            "one",
            pull,
            np.array((force, 0.0, 0.0)),
            np.zeros(3),
            model.free(pull, HANGING, (force, 0, 0, 0, 0, 0)).tip_position + 3e-4 * rng.normal(size=3),
            NONE,
            np.full(4, math.nan),
        )
        for force in (0.0, 0.3, 0.6, -0.3)
    )
    fit = ident.fit(smooth, LoadingTest(readings, HANGING), ("EI", "T0"))
    assert not fit.estimates["T0"].fitted
    assert fit.estimates["T0"].value == 4.0
    assert fit.estimates["EI"].value == pytest.approx(smooth.EI, rel=0.02)
    assert any("T0 stays as configured" in note for note in fit.notes)
    with pytest.raises(NotIdentifiable, match="tells nothing of T0"):
        ident.fit(smooth, LoadingTest(readings, HANGING), ("T0",))


def test_friction_comes_back_from_a_loop(nominal: ArmParameters) -> None:
    mu = 0.25
    model = RodModel(nominal)
    curves = stiffness_test.run(nominal, bends_deg=[45.0], mu=mu, steps=2, cycles=1)
    pull = case.goals(nominal, 45.0)
    rest = model.free(pull, np.zeros(3)).tip_position
    rng = np.random.default_rng(2)
    readings = tuple(
        Reading(
            f"{c.inward}",
            pull,
            np.zeros(3),
            np.array(((1 if c.inward else -1) * r.force, 0.0, 0.0)),
            rest + r.shift + 1e-5 * rng.normal(size=3),
            NONE,
            np.full(4, math.nan),
        )
        for c in curves
        for r in c.readings
    )
    fit = ident.fit(nominal, LoadingTest(readings, np.zeros(3)), ("mu",), mu=0.05)
    e = fit.estimates["mu"]
    assert e.fitted
    assert abs(e.value - mu) < max(4 * e.sigma, 0.01)
    assert e.sigma < 0.05


def test_too_little_data_and_unknown_names_are_refused(nominal: ArmParameters, exact: tuple[Reading, ...]) -> None:
    with pytest.raises(NotIdentifiable, match="no readings"):
        LoadingTest((), HANGING)
    bare = Reading("a", exact[0].pull, np.zeros(3), np.zeros(3), exact[0].position, NONE, np.full(4, math.nan))
    with pytest.raises(NotIdentifiable, match="3 measured values for 4"):
        ident.fit(nominal, LoadingTest((bare,), HANGING))
    with pytest.raises(NotIdentifiable, match="nothing is asked for"):
        ident.fit(nominal, LoadingTest(exact, HANGING), ())
    with pytest.raises(NotIdentifiable, match="no such parameter: rho"):
        ident.fit(nominal, LoadingTest(exact, HANGING), ("EI", "rho"))


def changed(readings: tuple[Reading, ...], **values: Callable[[Reading], Any]) -> LoadingTest:
    return LoadingTest(
        tuple(dataclasses.replace(r, **{name: value(r) for name, value in values.items()}) for r in readings), HANGING
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"follower": lambda r: -r.follower},  # outward taken for inward
        {"follower": lambda r: 0.00981 * r.follower},  # a load column in another unit
        {"follower": lambda r: 12 * r.follower},
        {"position": lambda r: r.position[[1, 2, 0]]},  # axes
        {"tension": lambda r: r.tension / 9.80665},  # kg
        {"tension": lambda r: r.tension / 4.448},  # pounds
        {"tension": lambda r: 10 * r.tension},
        {"tension": lambda r: r.tension[[1, 2, 3, 0]]},  # counted from another tendon
    ],
    ids=["sign", "unit", "large", "axes", "kg", "pounds", "tenfold", "order"],
)
def test_data_that_contradict_the_model_give_no_numbers(
    nominal: ArmParameters, exact: tuple[Reading, ...], wrong: dict[str, Callable[[Reading], Any]]
) -> None:
    with pytest.raises(NotIdentifiable, match=r"check units, signs and axes|check their unit and order"):
        ident.fit(nominal, changed(exact, **wrong), ("EI", "k_T", "T0"))


def test_a_parameter_far_from_the_configured_one_is_told(nominal: ArmParameters, exact: tuple[Reading, ...]) -> None:
    """Loads in pounds, and positions alone: a soft arm would show much the same."""
    pounds = changed(exact, follower=lambda r: r.follower / 4.448, tension=lambda _: np.full(4, math.nan))
    fit = ident.fit(nominal, pounds, ("EI",))
    assert any(note.startswith("EI is 0.") and "check units" in note for note in fit.notes)
    right = changed(exact, tension=lambda _: np.full(4, math.nan))
    assert not any("check units" in note for note in ident.fit(nominal, right, ("EI",)).notes)


# --- the file and the command ---

HEADER = "run,theta_deg,follower_x_n,x_m,y_m,z_m,tension_1_n,tension_2_n,tension_3_n,tension_4_n"


def as_csv(test: LoadingTest) -> str:
    lines = [HEADER]
    for r in test.readings:
        cells = [r.run, r.run, *map(repr, (float(r.follower[0]), *r.position.tolist(), *r.tension.tolist()))]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("", 1, "empty"),
        ("run,theta_deg,x_m\n", 1, "no readings"),
        ("theta_deg,x_m\n1,0\n", 1, "'run' is missing"),
        ("run,x_m\na,0\n", 1, "neither theta_deg nor"),
        ("run,theta_deg,pull_1_m,x_m\na,0,0,0\n", 1, "one command is enough"),
        ("run,theta_deg\na,0\n", 1, "nothing is measured"),
        ("run,theta_deg,x_mm\na,0,1\n", 1, "unknown column 'x_mm'"),
        ("run,theta_deg,x_m,x_m\na,0,1,1\n", 1, "twice"),
        ("run,theta_deg,tension_5_n\na,0,1\n", 1, "unknown column 'tension_5_n' for an arm of 4"),
        ("run,theta_deg,x_m\na,0,0\na,0\n", 3, "2 cells under 3 columns"),
        ("run,theta_deg,x_m\na,0,0\n\na,zero,0\n", 4, "theta_deg = 'zero' is no number"),
        ("run,theta_deg,x_m\na,0,0\na,0,nan\n", 3, "not finite"),
        ("run,theta_deg,x_m\na,,0\n", 2, "theta_deg is empty"),
        ("run,theta_deg,x_m\n,0,0\n", 2, "run has no name"),
        ("run,theta_deg,x_m\na,0,0\nb,0,0\na,0,0\n", 4, "goes on after another"),
        ("run,theta_deg,x_m\na,0,0\na,0,64.2\n", 3, "metres?"),
        ("run,theta_deg,tension_1_n\na,0,4\na,0,-4\n", 3, "cannot push"),
        ("run,theta_deg,tension_1_n\na,0,4\na,0,4100\n", 3, "newtons?"),
        ("run,theta_deg,force_x_n,x_m\na,0,0,0\na,0,100,0.02\n", 3, "newtons?"),  # grams
    ],
)
def test_bad_data_are_refused_with_their_line(text: str, line: int, reason: str) -> None:
    with pytest.raises(loading_csv.DataError) as caught:
        loading_csv.parse(text, RodModel(case.arm(Config())))
    assert caught.value.line == line
    assert f"line {line}: " in str(caught.value)
    assert reason in str(caught.value)


def test_goals_and_loads_are_read_where_they_stand() -> None:
    text = (
        "force_z_n,run, pull_1_m,pull_2_m,pull_3_m,pull_4_m,dx_m,dz_m\n"
        "0,a,0.01,0,-0.01,0,0,0\n"
        "-0.5,a,0.01,0,-0.01,0,0.004,\n"
    )
    first, second = loading_csv.parse(text, RodModel(case.arm(Config())))
    assert np.allclose(first.pull, (0.01, 0, -0.01, 0))
    assert np.allclose(second.force, (0, 0, -0.5))
    assert np.allclose(second.follower, 0)
    assert second.shift[0] == 0.004
    assert np.isnan([*second.shift[1:], *second.position, *second.tension]).all()


def calibrate(*words: object) -> int:
    try:
        return main(["calibrate", "stiffness", *map(str, words)])
    except SystemExit as stop:
        return int(stop.code or 0)


def test_the_command_fits_writes_and_what_it_writes_is_the_arm(
    tmp_path: Path, nominal: ArmParameters, exact: tuple[Reading, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    data, dropin, figure = tmp_path / "test.csv", tmp_path / "fit" / "arm.toml", tmp_path / "fit.png"
    data.write_text(as_csv(noisy(exact, 1)), encoding="utf-8")
    outputs = ("--output", dropin, "--figure", figure, "--json")
    assert calibrate(data, "--fit", "EI,k_T,T0", *outputs) == 0
    answer: dict[str, Any] = json.loads(capsys.readouterr().out)
    found = answer["parameters"]
    assert set(found) == {"EI_n_m2", "k_T_n_per_m", "T0_n", "mu"}
    assert found["EI_n_m2"]["lower"] < found["EI_n_m2"]["value"] < found["EI_n_m2"]["upper"]
    assert len(answer["residuals"]) == 8 * 7
    assert figure.read_bytes().startswith(b"\x89PNG")
    (tmp_path / "fit" / "mine.toml").write_text('extends = "arm.toml"\n[arm]\npulley_radius_m = 0.012\n')
    arm = ArmParameters.of(load(tmp_path / "fit" / "mine.toml").arm)
    assert pytest.approx(found["EI_n_m2"]["value"], rel=1e-5) == arm.EI
    assert arm.k_T[0] == pytest.approx(found["k_T_n_per_m"]["value"], rel=1e-5)
    assert arm.T0[0] == pytest.approx(found["T0_n"]["value"], rel=1e-5)
    assert pytest.approx(truth(nominal)["EI"], rel=0.02) == arm.EI


def test_the_command_prints_a_table(
    tmp_path: Path, exact: tuple[Reading, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "test.csv"
    data.write_text(as_csv(noisy(exact, 2)), encoding="utf-8")
    assert calibrate(data, "--fit", "EI") == 0
    out = capsys.readouterr().out
    assert "95 % from" in out
    assert "not fitted" in out
    assert "8 readings, 56 values, 55 degrees of freedom" in out


@pytest.mark.parametrize("servo", [20000.0, 2000.0])  # stiffer, and softer than the whole that was measured
def test_servo_stiffness_in_series_is_kept_unless_it_contradicts(tmp_path: Path, servo: float) -> None:
    k_T = ident.Estimate(3000.0, 30.0, 2940.0, 3060.0, fitted=True)
    still = ident.Estimate(1.0, 0.0, 1.0, 1.0, fitted=False)
    estimates = {"EI": still, "k_T": k_T, "T0": still, "mu": still}
    fit = ident.Fit(estimates, np.eye(1), {}, {}, (), (), np.zeros(0), np.zeros(0), 1, ())
    base, target = tmp_path / "base.toml", tmp_path / "fit.toml"
    base.write_text(f"[arm.tendons]\nservo_stiffness_n_per_m = {servo}\n", encoding="utf-8")
    target.write_text(drop_in(fit, load(base), base, target), encoding="utf-8")
    fitted = load(target).arm
    assert ArmParameters.of(fitted).k_T[0] == pytest.approx(3000, rel=1e-5)
    assert (fitted.tendons.servo_stiffness_n_per_m == servo) is (servo > 3000)
    assert 'extends = "base.toml"' in target.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["missing.csv"], "No such file"),
        (["bad.csv"], "bad.csv: line 2: theta_deg = 'x' is no number"),
        (["good.csv", "--fit", "EI,beta"], "no such parameter: beta"),
        (["good.csv", "--output", "a.toml", "--set", "arm.disks=9"], "--set"),
        (["good.csv"], "measured values for 4 parameters"),
        (["good.csv", "--attitude-deg", "nan", "0", "0"], "--attitude-deg"),
    ],
)
def test_refusals_of_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.csv").write_text("run,theta_deg,x_m\na,x,0\n", encoding="utf-8")
    Path("good.csv").write_text("run,theta_deg,x_m\na,0,0\n", encoding="utf-8")
    assert calibrate(*words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert reason in err


def test_the_output_never_costs_a_file_that_was_there(
    tmp_path: Path, exact: tuple[Reading, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    data, mine = Path("test.csv"), Path("mine.toml")
    data.write_text(as_csv(noisy(exact, 1)), encoding="utf-8")
    mine.write_text("[arm]\npulley_radius_m = 0.012\n", encoding="utf-8")
    kept = [file.read_bytes() for file in (data, mine)]
    words = (data, "--config", mine, "--fit", "EI", "--output")
    assert calibrate(*words, data) == 2
    assert "file of the measurements" in capsys.readouterr().err
    assert calibrate(*words, mine) == 78  # it would extend itself
    mine_d = Path("mine.d")
    mine_d.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("arm_companion.cli.calibrate.drop_in", lambda *_: "[arm.tendons]\nguide_friction = 3.0\n")
        assert calibrate(*words, mine_d / "50-fit.toml") == 78  # out of bounds: no daemon would start on it
    assert [file.read_bytes() for file in (data, mine)] == kept
    assert not list(mine_d.iterdir())
