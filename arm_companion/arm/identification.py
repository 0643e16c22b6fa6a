"""What an arm really is, from a loading test: EI, k_T, T0 and guide friction with their confidence intervals.

Least squares by Levenberg and Marquardt on the logarithms of EI, k_T and T0 (positive, and their spread is
relative) and on mu >= 0. Measurements come in kinds (tip position, tip shift, tension), whose scatter nobody knows
beforehand: it is estimated from what the fit leaves over, kind by kind, and weighs the next fit.

Not every test tells everything. Without measured tensions and with every tendon taut, pretension hardly shows; a
parameter whose interval would be wider than it is worth stays as configured, and the result says so.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from arm_companion.arm import friction
from arm_companion.arm.least_squares import levenberg_marquardt, student
from arm_companion.arm.model import ArmSolution
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.errors import ArmError, ModelError
from arm_companion.geometry.arrays import Array, frozen, sealed

NAMES = ("EI", "k_T", "T0", "mu")
POSITION, SHIFT, TENSION = "tip position", "tip shift", "tension"

_FLOOR = {POSITION: 1e-7, SHIFT: 1e-7, TENSION: 1e-5}  # scatter below which data count as exact, m and N
_BEST = {POSITION: 1e-5, SHIFT: 1e-5, TENSION: 1e-2}  # scatter that no measurement beats, to sort out what is hopeless
_GUESS = {POSITION: 1e-3, SHIFT: 1e-3, TENSION: 0.3}  # scatter to begin with
_ROUNDS = 4  # of weights
_LOOK = 1e-3  # of a parameter, for derivatives
_FACTOR = math.log(20)  # by which a parameter may leave its configured value
_SURPRISING = math.log(2.5)  # from which on people are told; pounds, kilograms and radians are farther off
_MU_MAX = 2.0
_USELESS = 0.5  # one sigma, relative, above which a parameter is not told by the test
_MU_USELESS = 0.2
_HOPELESS = 0.05  # scatter about the fit, of the length, at which the model does not describe the data
_FOREIGN = 0.2  # scatter of tensions about the fit, of their size, at which they are not this arm's
_FOREIGN_N = 0.5  # and not under this, N: small tensions are read no better
_CONFIDENCE = 0.95
_SUSPECTS = "check units, signs and axes of loads and readings"


class NotIdentifiable(ArmError):
    """The loading test does not determine what was asked of it."""


@dataclass(frozen=True, eq=False)
class Reading:
    """One row of a loading test.

    Attributes:
        run: readings of one run follow each other in time; the first is before the load.
        pull: tendon goals (n,), m.
        force: dead force on the tip (3,), N, base axes.
        follower: force on the tip that turns along (3,), N, tip axes.
        position: measured tip position (3,), m, base axes; nan where not measured.
        shift: measured displacement of the tip since the run's first reading (3,), m, base axes; nan likewise.
        tension: measured (n,), N; nan likewise.
    """

    run: str
    pull: Array
    force: Array
    follower: Array
    position: Array
    shift: Array
    tension: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "pull", frozen(self.pull, (-1,), "pull"))
        for name in ("force", "follower"):
            object.__setattr__(self, name, frozen(getattr(self, name), (3,), name))


@dataclass(frozen=True, eq=False)
class LoadingTest:
    """Readings in the order of time, in one field.

    Attributes:
        readings: run after run.
        gravity: (3,), m/s^2, base axes.
    """

    readings: tuple[Reading, ...]
    gravity: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "gravity", frozen(self.gravity, (3,), "gravity"))
        if not self.readings:
            raise NotIdentifiable("the loading test has no readings")


@dataclass(frozen=True)
class Estimate:
    """One parameter.

    Attributes:
        value: N m^2, N/m, N, or none for mu.
        sigma: one sigma, same unit; 0 when it was not fitted.
        lower: end of the confidence interval.
        upper: the other end.
        fitted: whether the test told it; else it is as configured.
    """

    value: float
    sigma: float
    lower: float
    upper: float
    fitted: bool


@dataclass(frozen=True, eq=False)
class Fit:
    """The result.

    Attributes:
        estimates: by name, of `NAMES`.
        correlation: between fitted parameters, in their order.
        scatter: one sigma of the measurements about the fit by kind, m or N.
        scatter_before: the same with the configured parameters (root mean square).
        channels: kind of every value.
        rows: index of the reading of every value.
        measured: values.
        predicted: by the fit.
        degrees: of freedom.
        notes: what was held fixed, and why, and what should be looked at twice.
    """

    estimates: Mapping[str, Estimate]
    correlation: Array
    scatter: Mapping[str, float]
    scatter_before: Mapping[str, float]
    channels: tuple[str, ...]
    rows: tuple[int, ...]
    measured: Array
    predicted: Array
    degrees: int
    notes: tuple[str, ...]


def fit(
    parameters: ArmParameters,
    test: LoadingTest,
    names: Sequence[str] = NAMES,
    *,
    mu: float = 0.0,
    fast: bool = False,
) -> Fit:
    """Fit the parameters named, the others staying as they are.

    Args:
        parameters: the arm as configured; where the fit begins.
        test: the measurements.
        names: which of `NAMES`.
        mu: friction where it is not fitted.
        fast: use compiled equations (extra `fast`).

    Raises:
        NotIdentifiable: when there are fewer measurements than parameters, when they tell nothing, or when model
            and data contradict each other.
    """
    asked = [name for name in NAMES if name in names]
    if unknown := set(names) - set(NAMES):
        raise NotIdentifiable(f"no such parameter: {', '.join(sorted(unknown))}")
    if not asked:
        raise NotIdentifiable("nothing is asked for")
    problem = _Problem(parameters, test, mu, fast)
    if len(problem.measured) <= len(asked):
        raise NotIdentifiable(f"{len(problem.measured)} measured values for {len(asked)} parameters")
    try:
        before = problem.scatter(problem.predict({}), 0)
    except ModelError as error:
        raise NotIdentifiable(f"{error}, with the arm as configured: {_SUSPECTS}") from error
    notes: list[str] = []
    x = {name: (0.1 if name == "mu" and mu == 0 else problem.begin(name)) for name in asked}
    # First without what even a perfect measurement would not tell, then without what this one does not.
    for judge in (problem.at, problem.fitted):
        solved = _judged(judge, x)
        while hopeless := _worst(solved.x, solved.covariance):
            name, sigma = hopeless
            share = f"{sigma:.2g}" if name == "mu" else f"{min(100 * sigma, 999):.0f} %"
            notes.append(f"{name} stays as configured: the test tells it to +-{share} at best")
            x = {other: value for other, value in solved.x.items() if other != name}
            if not x:
                raise NotIdentifiable("the test tells nothing of " + ", ".join(asked))
            solved = _judged(judge, x)
        x = solved.x
    _check(problem, solved)
    notes += [
        f"{name} is {math.exp(value):.2g} times what is configured: {_SUSPECTS}"
        for name, value in solved.x.items()
        if name != "mu" and abs(value) > _SURPRISING
    ]
    return _result(problem, solved, before, notes)


def _judged(judge: Callable[[Mapping[str, float]], "_Solved"], x: Mapping[str, float]) -> "_Solved":
    try:
        return judge(x)
    except ModelError as error:
        raise NotIdentifiable(f"data and model contradict each other ({error}): {_SUSPECTS}") from error


def _check(problem: "_Problem", solved: "_Solved") -> None:
    """Refuse a fit that ended where no arm is, or that does not describe its data."""
    for name, value in solved.x.items():
        if (name == "mu" and value >= _MU_MAX) or (name != "mu" and abs(value) >= 0.999 * _FACTOR):
            raise NotIdentifiable(f"the fit drives {name} out of all bounds: {_SUSPECTS}")
    for kind in (POSITION, SHIFT):
        off = solved.scatter.get(kind, 0.0)
        if off > _HOPELESS * problem.parameters.L:
            raise NotIdentifiable(f"after the fit the {kind} is still off by {1e3 * off:.0f} mm: {_SUSPECTS}")
    # Positions hold the fit together while tensions of another unit or order pull k_T and T0 away from the arm's. Where
    # T0 is held they may be off for that alone.
    tensions = problem.measured[np.array(problem.channels) == TENSION]
    off = solved.scatter.get(TENSION, 0.0)
    if "T0" in solved.x and tensions.size and off > max(_FOREIGN * math.sqrt(float(np.mean(tensions**2))), _FOREIGN_N):
        raise NotIdentifiable(
            f"after the fit the tensions are still off by {off:.1f} N: check their unit and order, or leave them out"
        )


class _Problem:
    """The test as a function from parameters to what should have been measured."""

    def __init__(self, parameters: ArmParameters, test: LoadingTest, mu: float, fast: bool) -> None:
        self.parameters, self.test, self.mu, self.fast = parameters, test, mu, fast
        self._starts: list[ArmSolution | None] = [None] * len(test.readings)
        channels: list[str] = []
        rows: list[int] = []
        places: list[tuple[int, str, int]] = []
        measured: list[float] = []
        for i, reading in enumerate(test.readings):
            for kind, values in ((POSITION, reading.position), (SHIFT, reading.shift), (TENSION, reading.tension)):
                for j, value in enumerate(np.asarray(values).tolist()):
                    first = kind == SHIFT and (i == 0 or test.readings[i - 1].run != reading.run)
                    if not math.isnan(value) and not first:
                        channels.append(kind)
                        rows.append(i)
                        places.append((i, kind, j))
                        measured.append(value)
        self.channels, self.rows, self.places = tuple(channels), tuple(rows), places
        self.measured = sealed(np.array(measured))

    def begin(self, name: str) -> float:
        """Coordinate of a parameter as configured: logarithm of its factor, or mu itself."""
        return self.mu if name == "mu" else 0.0

    def arm(self, x: Mapping[str, float]) -> tuple[ArmParameters, float]:
        """Arm and friction at coordinates."""
        factors = {name: math.exp(value) for name, value in x.items() if name != "mu"}
        # GJ is made of the same wire as EI.
        scaled = self.parameters.scaled(GJ=factors.get("EI", 1.0), **factors)
        return scaled, x.get("mu", self.mu)

    def predict(self, x: Mapping[str, float]) -> Array:
        """Values (q,) in the order of `measured`."""
        parameters, mu = self.arm(x)
        model = RodModel(parameters, fast=self.fast)
        result = np.empty(len(self.places))
        seen: list[ArmSolution] = []
        first: list[ArmSolution] = []
        grip: friction.Grip | None = None
        for i, reading in enumerate(self.test.readings):
            new = i == 0 or self.test.readings[i - 1].run != reading.run
            load, turning = (np.concatenate((f, np.zeros(3))) for f in (reading.force, reading.follower))
            start = self._starts[i] or (None if new else seen[-1])
            try:
                if new or grip is None or mu <= 0:
                    now = model.free(reading.pull, self.test.gravity, load, follower_wrench=turning, start=start)
                    grip = friction.Grip.relaxed(now)
                else:
                    now, grip = friction.step(
                        model, mu, grip, reading.pull, self.test.gravity, load, follower_wrench=turning, start=start
                    )
            except ModelError as error:
                raise ModelError(f"reading {i + 1}, run {reading.run!r}: {error}") from error
            self._starts[i] = now
            seen.append(now)
            first.append(now if new else first[-1])
        for k, (i, kind, j) in enumerate(self.places):
            if kind == TENSION:
                result[k] = seen[i].tension[j]
            else:
                result[k] = seen[i].tip_position[j] - (first[i].tip_position[j] if kind == SHIFT else 0.0)
        return result

    def at(self, x: Mapping[str, float]) -> "_Solved":
        """How well a perfect measurement would tell these parameters, about these values."""
        here = self.predict(x)
        J = np.column_stack([(self.predict({**x, name: x[name] + _LOOK}) - here) / _LOOK for name in x])
        return _Solved(dict(x), _covariance(J, _BEST, self.channels), here, dict(_BEST))

    def fitted(self, start: Mapping[str, float]) -> "_Solved":
        """Fit and weights in turn until the weights stay."""
        names = list(start)
        x = np.array([start[name] for name in names])
        lower = np.array([0.0 if name == "mu" else -_FACTOR for name in names])
        upper = np.array([_MU_MAX if name == "mu" else _FACTOR for name in names])
        scatter = {kind: _GUESS[kind] for kind in _GUESS if kind in self.channels}
        predicted = self.measured
        J = np.zeros((len(self.measured), len(names)))
        for _ in range(_ROUNDS):
            weight = 1 / np.array([scatter[kind] for kind in self.channels])

            def residual(values: Array, weight: Array = weight) -> Array:
                predicted = self.predict(dict(zip(names, values.tolist(), strict=True)))
                return np.asarray((predicted - self.measured) * weight)

            x, r, J = levenberg_marquardt(residual, x, lower, upper)
            predicted = self.measured + r / weight
            J = J / weight[:, None]
            old, scatter = scatter, self.scatter(predicted, len(names))
            if len(scatter) == 1 or all(abs(scatter[kind] / old[kind] - 1) < 0.02 for kind in scatter):
                break
        covariance = _covariance(J, scatter, self.channels)
        return _Solved(dict(zip(names, x.tolist(), strict=True)), covariance, predicted, scatter)

    def scatter(self, predicted: Array, fitted: int) -> dict[str, float]:
        """One sigma of every kind about a prediction with `fitted` free parameters."""
        names = np.array(self.channels)
        share = 1 - fitted / len(self.measured)
        off = (self.measured - predicted) ** 2
        return {
            kind: max(math.sqrt(float(off[names == kind].mean()) / share), _FLOOR[kind])
            for kind in (POSITION, SHIFT, TENSION)
            if kind in self.channels
        }


@dataclass(eq=False)
class _Solved:
    x: dict[str, float]
    covariance: Array
    predicted: Array
    scatter: dict[str, float]


def _worst(x: Mapping[str, float], covariance: Array) -> tuple[str, float] | None:
    """The parameter that the test tells least of, if too little, and its one sigma."""
    sigmas = np.sqrt(np.diag(covariance)).tolist()
    ratios = [(s / (_MU_USELESS if name == "mu" else _USELESS), name, s) for name, s in zip(x, sigmas, strict=True)]
    share, name, sigma = max(ratios)
    return (name, sigma) if share > 1 else None


def _covariance(J: Array, scatter: Mapping[str, float], channels: Sequence[str]) -> Array:
    """Of the parameters (p, p); barely told combinations get a huge variance, not a division by zero."""
    weighted = J / np.array([scatter[kind] for kind in channels])[:, None]
    values, axes = np.linalg.eigh(weighted.T @ weighted)
    return np.asarray(axes @ ((1 / np.maximum(values, 1e-6))[:, None] * axes.T))


def _result(problem: _Problem, solved: _Solved, before: dict[str, float], notes: list[str]) -> Fit:
    degrees = len(problem.measured) - len(solved.x)
    t = student(_CONFIDENCE, degrees)
    arm, mu = problem.arm(solved.x)
    values = {"EI": arm.EI, "k_T": float(arm.k_T[0]), "T0": float(arm.T0[0]), "mu": mu}
    fitted = list(solved.x)
    sigma = np.sqrt(np.diag(solved.covariance))
    estimates = {}
    for name in NAMES:
        value = values[name]
        if name not in solved.x:
            estimates[name] = Estimate(value, 0.0, value, value, fitted=False)
            continue
        s = float(sigma[fitted.index(name)])
        if name == "mu":
            estimates[name] = Estimate(value, s, max(0.0, value - t * s), value + t * s, fitted=True)
        else:
            estimates[name] = Estimate(value, value * s, value * math.exp(-t * s), value * math.exp(t * s), fitted=True)
    return Fit(
        estimates=estimates,
        correlation=sealed(solved.covariance / np.outer(sigma, sigma)),
        scatter=solved.scatter,
        scatter_before=before,
        channels=problem.channels,
        rows=problem.rows,
        measured=problem.measured,
        predicted=sealed(solved.predicted),
        degrees=degrees,
        notes=tuple(notes),
    )
