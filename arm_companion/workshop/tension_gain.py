"""`calibrate tension` as a procedure, and its fit: known tensions, each taken in and let out.

The load of a turning servo is `load = offset + (tension +- friction) / gain`, plus on the way in and minus on the way
out. Three tensions in both directions give gain, offset and friction with their confidence.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arm_companion.arm.least_squares import student
from arm_companion.arm.tension import LoadCurve
from arm_companion.errors import ModelError
from arm_companion.procedures.actions import Ask, AskNumber, Engage, Move, Procedure, Refused, Release, Say, Trace

STANDARD_GRAVITY = 9.80665
_LEAD = 10  # samples in which a servo starts or stops
_LEAST_SAMPLES = 20
_LEAST_TENSIONS = 3
_LEAST_SPAN_N = 3.0
_CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Reading:
    """One tension in one direction.

    Attributes:
        tension: known, N.
        direction: +1 taken in, -1 let out.
        load: mean, share of full load.
        noise: one sigma of a single reading of the load.
        voltage: of the supply, V.
    """

    tension: float
    direction: int
    load: float
    noise: float
    voltage: float


@dataclass(frozen=True, slots=True)
class Fit:
    """The curve, and how sure it is.

    Attributes:
        curve: from load to tension.
        gain: 95 % interval, N at 100 % load.
        friction: 95 % interval, N.
        offset: 95 % interval, share of full load.
        scatter: of the tensions about the curve, N.
        readings: how many.
    """

    curve: LoadCurve
    gain: tuple[float, float]
    friction: tuple[float, float]
    offset: tuple[float, float]
    scatter: float
    readings: int


@dataclass(frozen=True, slots=True)
class Bench:
    """How the tensions are made."""

    scale: bool = False  # a spring scale in N, read on the way; otherwise weights in kg
    travel: float = 0.02  # m
    speed: float = 0.004  # m/s
    tension_max: float = 45.0  # N


def fit(readings: Sequence[Reading]) -> Fit:
    """Gain, offset and friction by least squares.

    Raises:
        ModelError: too few tensions, or loads that do not grow with them.
    """
    tensions = {round(reading.tension, 2) for reading in readings if reading.direction > 0}
    if len(tensions) < _LEAST_TENSIONS or max(tensions) - min(tensions) < _LEAST_SPAN_N:
        raise ModelError(f"at least {_LEAST_TENSIONS} tensions are needed, {_LEAST_SPAN_N:g} N or more apart")
    if not any(reading.direction < 0 for reading in readings):
        raise ModelError("no reading on the way out counts: friction and offset cannot be told apart")
    volts = float(np.mean([reading.voltage for reading in readings]))
    A = np.array([(reading.tension, reading.direction, 1.0) for reading in readings])
    load = np.array([reading.load * reading.voltage / volts for reading in readings])
    x, *_ = np.linalg.lstsq(A, load, rcond=None)
    per_newton, drag, offset = (float(v) for v in x)
    if not per_newton > 0.0:
        raise ModelError("the load does not grow with the tension: is that tendon on this servo?")
    if drag < 0.0:
        raise ModelError("the load is smaller on the way in than on the way out: check servos.directions")
    degrees = len(readings) - 3
    r = load - A @ x
    variance = float(r @ r) / degrees
    covariance = variance * np.linalg.inv(A.T @ A)
    sigma = np.sqrt(np.diag(covariance))
    gain, friction = 1.0 / per_newton, drag / per_newton
    gain_sigma = float(sigma[0]) / per_newton
    # friction = drag / per_newton: its variance by the derivatives
    d = np.array((-drag / per_newton**2, 1.0 / per_newton, 0.0))
    friction_sigma = math.sqrt(float(d @ covariance @ d))
    scatter = math.sqrt(variance) * gain
    noise = math.sqrt(float(np.mean([reading.noise**2 for reading in readings])))
    curve = LoadCurve(gain, volts, gain_sigma, offset, friction, math.hypot(friction_sigma, scatter), noise)
    t = student(_CONFIDENCE, degrees)
    return Fit(
        curve,
        _interval(gain, t * gain_sigma * gain),
        _interval(friction, t * friction_sigma),
        _interval(offset, t * float(sigma[2])),
        scatter,
        len(readings),
    )


def _interval(value: float, half: float) -> tuple[float, float]:
    return value - half, value + half


def reading(trace: Trace, i: int, tension: float, direction: int) -> Reading:
    """What one stroke says.

    Raises:
        Refused: it was too short.
    """
    loads = np.array(trace.load(i)[_LEAD:-_LEAD])
    if loads.size < _LEAST_SAMPLES:
        raise Refused("the stroke is too short: more --travel-mm or less --speed-mm-s")
    volts = float(np.mean([sample.voltage[i] for sample in trace.samples]))
    return Reading(tension, direction, float(loads.mean()), float(loads.std(ddof=1)), volts)


def procedure(i: int, name: str, n: int, bench: Bench) -> Procedure[Fit]:
    """Measure one servo.

    Args:
        i: its place in the tendons' order.
        name: of the tendon, for people.
        n: number of servos.
        bench: how the tensions are made.

    Raises:
        Refused: the series does not do.
    """
    what = "a spring scale to its end" if bench.scale else "weights on its end, led over the edge"
    yield Ask(
        f"{name}: take its far end off the arm and fix {what}.\n"
        f"Torque comes on now. For each tension the servo takes in {1e3 * bench.travel:.0f} mm and lets them out "
        "again;\nthe load on both ways tells gain and friction apart. Heavy and light, at least three tensions.",
        sure=False,
    )
    yield Engage()
    readings: list[Reading] = []
    goal = tuple(bench.travel if k == i else 0.0 for k in range(n))
    while True:
        tension = None if bench.scale else (yield from _weight(bench))
        if tension is None and not bench.scale:
            break
        if bench.scale and not (yield Ask("Enter for one more stroke, n to end the series.", sure=False)):
            break
        for direction, end in ((1, goal), (-1, (0.0,) * n)):
            trace: Trace = yield Move(end, bench.speed)
            known = tension
            if known is None:
                way = "in" if direction > 0 else "out"
                known = yield AskNumber(f"What did the scale say on the way {way}, N? (empty: do not count it)")
            if known is None:
                continue
            if 0.0 <= known <= bench.tension_max:
                readings.append(reading(trace, i, known, direction))
            else:
                yield Say(f"{known:g} N is not between 0 and {bench.tension_max:g} N: it does not count.")
        count = len({r.tension for r in readings if r.direction > 0})
        yield Say(f"{count} tensions so far.")
    yield Ask("Take the weight or scale off: the torque goes off now.", sure=False)
    yield Release()
    try:
        return fit(readings)
    except (ModelError, np.linalg.LinAlgError) as error:
        raise Refused(f"{name}: {error}") from error


def _weight(bench: Bench) -> Procedure[float | None]:
    """The tension of the next weight, N; None when the series has ended."""
    while True:
        mass: float | None = yield AskNumber("Hang a weight on it and type its mass in kg (0: none; empty: all done).")
        if mass is None:
            return None
        if 0.0 <= mass * STANDARD_GRAVITY <= bench.tension_max:
            return mass * STANDARD_GRAVITY
        yield Say(f"{mass:g} kg is not between 0 and {bench.tension_max / STANDARD_GRAVITY:.2f} kg.")


def describe(result: Fit) -> str:
    """The fit in words."""
    rows = (
        ("gain", result.curve.gain, result.gain, "N at 100 % load"),
        ("friction", result.curve.friction, result.friction, "N"),
        ("offset", 100 * result.curve.offset, tuple(100 * v for v in result.offset), "% load"),
    )
    lines = [
        f"  {name:<9}{value:8.2f} {unit:<16} 95 %: {ends[0]:.2f} to {ends[1]:.2f}" for name, value, ends, unit in rows
    ]
    return "\n".join([*lines, f"  {result.readings} readings scatter by {result.scatter:.2f} N about the fit"])
