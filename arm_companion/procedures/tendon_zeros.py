"""`calibrate tendons` as a procedure: slack off, take up each tendon in turn, then all together, then store."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.tension import LoadCurve
from arm_companion.errors import ModelError
from arm_companion.geometry.arrays import Array
from arm_companion.procedures.actions import (
    Ask,
    Engage,
    Keep,
    Move,
    Procedure,
    Refused,
    Release,
    Sample,
    Say,
    Stop,
    Trace,
)
from arm_companion.procedures.take_up import balanced, combine, knee

_FREE_RUN_M = 0.008
_STROKES = 8
_FIRST_STROKES = 2  # which even out the tendons
_STROKE_SPEED = 0.004  # m/s, at most
_LOOSE_M = 0.0005
_FARTHEST_M = 0.01
_LEAD = 10  # samples in which a servo starts or stops
_CLEAR_M = 0.001
_LEAST_TAUT = 50  # samples
_LEAST_SHARE = 0.2  # of the pretension, that every tendon must have when all are taken up
_FELT = 1.5  # N, least pretension that stands out from friction and noise of a load
_STIFFNESS_SPREAD = 0.2  # relative, of the tendons' stiffness
_LEVEL_READINGS = 300  # about as many tell the load of a slack servo
_LET_OUT_TRIES = 3
_TIGHT = 1.5  # times the pretension, to which all tendons are taken together


@dataclass(frozen=True, slots=True)
class Options:
    """How gently."""

    threshold: float = 4.0  # N, at which a tendon alone counts as taken up
    slack: float = 0.028  # m, by which all tendons are let out first
    speed: float = 0.003  # m/s
    travel: float = 0.08  # m, farthest way to the threshold


def least_slack(arm: ArmParameters, threshold: float) -> float:
    """Slack, m, that the opposite tendon needs when one alone pulls with `threshold` N and bends the arm towards it."""
    return arm.r**2 * arm.L / arm.EI * threshold + 0.002


@dataclass(frozen=True, slots=True)
class Found:
    """One tendon alone."""

    knee_ticks: float
    sigma: float  # m
    inwards: float  # load of the slack servo on the way in, share of full load
    outwards: float
    noise: float
    friction: float  # N
    temperature: float  # degC


@dataclass(frozen=True, slots=True)
class Zero:
    """The result for one tendon."""

    ticks: int
    sigma: float  # m
    friction: float  # N
    temperature: float  # degC


@dataclass(frozen=True, slots=True)
class Setup:
    """What the procedure needs to know of the arm."""

    arm: ArmParameters
    curves: tuple[LoadCurve, ...]
    directions: tuple[int, ...]
    ids: tuple[int, ...]
    m_per_tick: float
    tension_max: float  # N
    options: Options = Options()

    @property
    def n(self) -> int:
        """Number of tendons."""
        return len(self.ids)


def procedure(setup: Setup, done: tuple[Found, ...] = ()) -> Procedure[tuple[Zero, ...]]:
    """Find the zeros of all tendons.

    Args:
        setup: the arm.
        done: tendons that an interrupted run has found already.

    Returns:
        The zeros, in the tendons' order.

    Raises:
        Refused: something is not as it should be.
    """
    if (least := float(setup.arm.T0.min())) < _FELT:
        raise Refused(
            f"arm.tendons.pretension_n is {least:g}: under {_FELT:g} N are not felt through the gears of a servo; "
            "set more, or servos.zero_ticks by hand"
        )
    yield Ask(
        "The arm must hang straight down by itself, free to bend, the vehicle level and its propellers off.\n"
        "Torque comes on now; every servo stays where it is."
    )
    origin: tuple[int, ...] = yield Engage()
    slack = -setup.options.slack
    yield Ask(
        f"All tendons are let out by {1e3 * setup.options.slack:.0f} mm, so that each can be felt on its own.\n"
        "Keep an eye on the pulleys: no tendon may jump off."
    )
    yield Move((slack,) * setup.n, setup.options.speed * 2.0)
    found = list(done)
    for i in range(len(found), setup.n):
        one, slack = yield from _take_up(setup, i, origin, slack)
        found.append(one)
        yield Keep(tuple(found))
    knees = [setup.directions[i] * (one.knee_ticks - origin[i]) * setup.m_per_tick for i, one in enumerate(found)]
    zeros, sigmas = yield from _together(setup, found, knees)
    yield Say("All tendons are let out to where they start to pull, and the torque goes off.")
    yield Move(tuple(float(z) - setup.arm.T0[i] / setup.arm.k_T[i] for i, z in enumerate(zeros)), setup.options.speed)
    yield Release()
    return tuple(
        Zero(
            round(origin[i] + setup.directions[i] * float(zeros[i]) / setup.m_per_tick),
            float(sigmas[i]),
            one.friction,
            one.temperature,
        )
        for i, one in enumerate(found)
    )


def _take_up(setup: Setup, i: int, origin: Sequence[int], slack: float) -> Procedure[tuple[Found, float]]:
    """One tendon alone; what was found of it, and how far all tendons are let out now, m."""
    options, name = setup.options, _name(setup, i)
    yield Ask(
        f"Slack of {name} is taken up until it pulls with {options.threshold:g} N. Alone it bends the arm towards it\n"
        "by some 60 degrees; that tells where it becomes taut. Then it is let out again."
    )
    for attempt in range(_LET_OUT_TRIES):
        one = yield from _in_and_out(setup, i, origin, slack, ask=attempt == 0)
        at = setup.directions[i] * (one.knee_ticks - origin[i]) * setup.m_per_tick
        if at > slack + _FREE_RUN_M + _CLEAR_M:
            yield Say(
                f"{name} is taut from {1e3 * at:+.2f} mm on, give or take {1e3 * one.sigma:.2f} mm; its gears take "
                f"{one.friction:.1f} N."
            )
            return one, slack
        slack -= options.slack
        yield Say(f"{name} was not slack to begin with: all tendons are let out further.")
        yield Move((slack,) * setup.n, options.speed * 2.0)
    raise Refused(f"{name} does not become slack: does the arm hang free, and is servos.directions right?")


def _in_and_out(setup: Setup, i: int, origin: Sequence[int], slack: float, *, ask: bool) -> Procedure[Found]:
    """A free run, on to the threshold, and back: the slack servo's own load, and the knee."""
    options, name = setup.options, _name(setup, i)
    free: Trace = yield Move(_one(setup, i, slack, slack + _FREE_RUN_M), options.speed)
    gain = setup.curves[i].gain * _volts(free, i) / setup.curves[i].volts
    running = free.load(i)[_LEAD:]
    resting = sum(running) / max(len(running), 1)
    stop = Stop(i, resting + options.threshold / gain)
    taken: Trace = yield Move(_one(setup, i, slack, slack + options.travel), options.speed, stop)
    if not taken.stopped:
        raise Refused(
            f"{name} does not pull within {1e3 * options.travel:.0f} mm: is it broken or off its pulley, is its "
            "direction (servos.directions) wrong, or must it be made shorter by hand?"
        )
    if ask and not (
        yield Ask(f"The arm should be bent towards tendon {i + 1} now. Enter if it is, n if it bends another way.")
    ):
        raise Refused(f"{name} pulls elsewhere: check servos.ids, servos.directions and arm.tendons.angles_deg")
    back: Trace = yield Move((slack,) * setup.n, options.speed)
    parts = ((free.samples[_LEAD:], True), (taken.samples[_LEAD:], True), (back.samples[_LEAD:-_LEAD], False))
    try:
        bend = knee(
            [sample.wound[i] for samples, _ in parts for sample in samples],
            [sample.load[i] for samples, _ in parts for sample in samples],
            [inwards for samples, inwards in parts for _ in samples],
        )
    except ModelError as error:
        raise Refused(f"{name}: {error}") from error
    return Found(
        origin[i] + setup.directions[i] * bend.at / setup.m_per_tick,
        bend.sigma,
        bend.inwards,
        bend.outwards,
        bend.noise,
        gain * bend.friction,
        back.samples[-1].temperature[i],
    )


def _name(setup: Setup, i: int) -> str:
    return f"tendon {i + 1} (servo {setup.ids[i]})"


def _volts(trace: Trace, i: int) -> float:
    return max(trace.samples[-1].voltage[i], 1.0)


def _one(setup: Setup, i: int, rest: float, wound: float) -> tuple[float, ...]:
    return tuple(wound if k == i else rest for k in range(setup.n))


def _together(setup: Setup, found: Sequence[Found], knees: Sequence[float]) -> Procedure[tuple[Array, Array]]:
    """All tendons at once, which holds the arm straight: their common tightness."""
    arm, options = setup.arm, setup.options
    yield Ask(
        f"All tendons are taken up together, to about {_TIGHT * float(arm.T0.max()):.0f} N and back, "
        f"{_STROKES} times.\nThe arm stays straight; this tells how tight they are against each other."
    )
    speed = min(options.speed, _STROKE_SPEED)
    loads = [
        one.inwards + min(_TIGHT * float(T0), 0.5 * setup.tension_max) / curve.gain
        for one, curve, T0 in zip(found, setup.curves, arm.T0, strict=True)
    ]
    yield Move(tuple(at - _LOOSE_M for at in knees), options.speed)
    first: Trace = yield Move(tuple(at + _FARTHEST_M for at in knees), speed, Stop(None, sum(loads) / setup.n))
    if not first.stopped:
        raise Refused(
            f"the tendons do not get tight together within {1e3 * _FARTHEST_M:.0f} mm: is one of them caught, or is "
            "arm.tendons not this arm's?"
        )
    tight = first.samples[-1].wound
    stroke = (_TIGHT * float(arm.T0.max())) / float(arm.k_T.min()) + _LOOSE_M
    loose = tuple(wound - stroke for wound in tight)
    span = 2.0 * (_TIGHT - 1.0) * float(np.mean(arm.T0 / arm.k_T))
    even = balanced(arm.H)
    even = even @ even.T  # what of a change makes tendons tighter without bending the arm
    x: list[Array] = []
    y: list[Array] = []
    for stroke_number in range(_STROKES):
        for goal, inwards in ((loose, False), (tight, True)):
            trace: Trace = yield Move(goal, speed)
            inside = trace.samples[_LEAD:-_LEAD]
            wound = np.array([sample.wound for sample in inside])
            force = np.array([_forces(setup, found, sample, inwards=inwards) for sample in inside])
            # about as far below the pretension as above: then the stiffness hardly matters
            taut = wound.mean(axis=1) > sum(tight) / setup.n - span if len(inside) else np.zeros(0, dtype=np.bool_)
            if stroke_number >= _FIRST_STROKES:
                x.append(wound[taut])
                y.append(force[taut])
        if stroke_number < _FIRST_STROKES and taut.any():
            # one pair may be tight before another is: even them out
            at = np.asarray(tight) - wound[taut].mean(axis=0)
            missing = even @ ((_TIGHT * arm.T0 - force[taut].mean(axis=0)) / arm.k_T - at)
            change = np.clip(missing, -_FARTHEST_M, _FARTHEST_M / 4)
            tight = tuple((np.asarray(tight) + change).tolist())
            loose = tuple((np.asarray(loose) + change).tolist())
    return _solve(setup, found, np.asarray(knees), np.concatenate(x), np.concatenate(y))


def _forces(setup: Setup, found: Sequence[Found], sample: Sample, *, inwards: bool) -> list[float]:
    """Tensions (n,), N, while all servos turn one way."""
    return [
        curve.gain * (volts / curve.volts) * (load - (one.inwards if inwards else one.outwards))
        for curve, one, load, volts in zip(setup.curves, found, sample.load, sample.voltage, strict=True)
    ]


def _solve(setup: Setup, found: Sequence[Found], knees: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Zeros (n,), m, and their sigma, from knees (n,), m, and from lengths x (q, n), m, with tensions y (q, n), N.

    A taut tendon has `x = zero + H u + (tension - T0) / k`. What bends nothing is orthogonal to H, so that the bend u,
    which nobody knows, drops out of `N^T x`.
    """
    arm = setup.arm
    stretch = arm.T0 / arm.k_T  # from the knee to the pretension, for the arm held straight
    count = len(y)
    tension = y.mean(axis=0) if count else np.zeros(setup.n)
    if count < _LEAST_TAUT or tension.min() < _LEAST_SHARE * float(arm.T0.min()):
        weakest = int(np.argmin(tension))
        raise Refused(
            f"all together, {_name(setup, weakest)} pulls with {float(tension[weakest]):.1f} N where about "
            f"{float(arm.T0[weakest]):.1f} N were expected: is a tendon caught, or is arm.tendons not this arm's?"
        )
    N = balanced(arm.H)
    together = N.T @ (x.mean(axis=0) - (tension - arm.T0) / arm.k_T)
    noise = np.array([curve.gain * one.noise for curve, one in zip(setup.curves, found, strict=True)])
    # of the readings here, of the slack servos' loads before, of the gain, and of the stiffness taken for granted
    readings = noise * math.sqrt(1.0 / count + 1.0 / _LEVEL_READINGS)
    gain = np.array([curve.gain_sigma for curve in setup.curves]) * arm.T0
    spread = np.sqrt(readings**2 + gain**2 + (_STIFFNESS_SPREAD * (tension - arm.T0)) ** 2)
    together_sigma = np.sqrt(N.T**2 @ np.square(spread / arm.k_T))
    alone_sigma = np.array([one.sigma for one in found])
    return combine(knees + stretch, alone_sigma, N, together, together_sigma)
