"""Random questions to the rod model, from the daily to the absurd, each told by its seed and number alone."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from arm_companion.arm.model import ArmSolution, Hold, HoldKind, Payload
from arm_companion.arm.parameters import ArmParameters, Guides, Segment, Tendon
from arm_companion.arm.rod_model import RodModel
from arm_companion.errors import ModelError
from arm_companion.geometry import so3
from arm_companion.geometry.se3 import Pose
from tests.soak.check import Asked

KINDS = list(HoldKind)


@dataclass(frozen=True, eq=False)
class Case:
    """One question.

    Attributes:
        seed: of the whole series.
        number: in the series.
        asked: what.
        start: a neighbouring solution to start from, or None.
    """

    seed: int
    number: int
    asked: Asked
    start: ArmSolution | None


def arm(rng: np.random.Generator) -> ArmParameters:
    """Any length, radius, stiffness, mass and pretension; three to six tendons to each of up to two segments."""
    guides = Guides.DISKS if rng.random() < 0.5 else Guides.CONTINUOUS
    segments, tendons = [], []
    EI, r = 10 ** rng.uniform(-2.5, -0.7), rng.uniform(0.006, 0.03)
    k_T, T0 = 10 ** rng.uniform(2.8, 4.2), float(rng.choice((0.0, 0.3, 1.0, 4.0, 10.0)))
    for k in range(2 if rng.random() < 0.15 else 1):
        count = int(rng.integers(3, 7))
        here = EI * rng.uniform(0.5, 1.5)
        segments.append(
            Segment(
                L=rng.uniform(0.1, 0.5),
                r=r,
                disks=int(rng.integers(6, 25)),
                EI=here,
                GJ=here / rng.uniform(1.0, 1.5),
                line_mass=rng.uniform(0.0, 0.3),
                end_mass=rng.uniform(0.0, 0.03),
            )
        )
        first = rng.uniform(0, 2 * math.pi)
        for j in range(count):
            angle = first - 2 * math.pi * (j + rng.uniform(-0.15, 0.15)) / count
            tendons.append(Tendon(angle, k_T, T0, segment=k))
    return ArmParameters(tuple(segments), tuple(tendons), guides)


def cases(seed: int, count: int, *, fast: bool, first: int = 0) -> Iterator[tuple[Case, RodModel]]:
    """Questions and the model to ask; ten to every arm."""
    number = first - first % 10
    while number < first + count:
        rng = np.random.default_rng((seed, number))
        P = arm(rng)
        model = RodModel(P, fast=fast)
        last: ArmSolution | None = None
        for _ in range(10):
            case = _case(rng, seed, number, model, last)
            last = case.start
            yield case, model
            number += 1


def _size(rng: np.random.Generator, least: float, most: float) -> float:
    """Over decades, or nothing."""
    return 0.0 if rng.random() < 0.2 else 10 ** rng.uniform(math.log10(least), math.log10(most))


def _direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.sqrt(v @ v)


def _bend(rng: np.random.Generator, P: ArmParameters) -> np.ndarray:
    """Straight, nearly straight, or bent, every segment its own way."""
    u = []
    for _ in P.segments:
        theta = rng.uniform(0, 2.5) if rng.random() < 0.7 else _size(rng, 1e-9, 1e-2)
        delta = rng.uniform(-math.pi, math.pi)
        u += [theta * math.cos(delta), theta * math.sin(delta)]
    return np.array(u)


def _wrench(rng: np.random.Generator, P: ArmParameters, most: float) -> np.ndarray:
    """Up to `most` of the load that bends the arm by a radian."""
    force = _direction(rng) * _size(rng, 1e-3, most) * P.EI / P.L**2
    return np.concatenate((force, _direction(rng) * _size(rng, 1e-3, 0.5 * most) * P.EI / P.L))


def _case(rng: np.random.Generator, seed: int, number: int, model: RodModel, last: ArmSolution | None) -> Case:
    P = model.parameters
    gravity = _direction(rng) * _size(rng, 1.0, 20.0)
    pull = model.pull_for_bend(_bend(rng, P)) + rng.normal(size=P.n) * _size(rng, 1e-6, 1e-3)
    tension = rng.uniform(0, 8, size=P.n) * (rng.random(P.n) > 0.2) if rng.random() < 0.15 else None
    asked = Asked(P, pull, gravity, tension)
    if rng.random() < 0.4:
        payload = Payload(_size(rng, 1e-3, 0.2), 0.03 * rng.normal(size=3)) if rng.random() < 0.5 else None
        dead = _wrench(rng, P, 6.0) if rng.random() < 0.7 else None
        follower = _wrench(rng, P, 3.0) if rng.random() < 0.4 else None
        return Case(seed, number, replace(asked, payload=payload, dead=dead, follower=follower), last)
    try:
        free = model.free(pull, gravity, tension=tension)
    except ModelError:  # then it is asked what was refused
        return Case(seed, number, asked, None)
    return Case(seed, number, replace(asked, hold=_hold(rng, P, free)), free if rng.random() < 0.3 else None)


def _hold(rng: np.random.Generator, P: ArmParameters, free: ArmSolution) -> Hold:
    """Gripped where the free arm is, then the base moves and turns: anywhere, or to just short of taut."""
    s = P.L * (1.0 if rng.random() < 0.5 else rng.uniform(0.3, 1.0))
    kind = KINDS[int(rng.integers(3))]
    axis = _direction(rng) if kind is HoldKind.BAR else None
    pivot = 0.02 * rng.normal(size=3) if kind is not HoldKind.CLAMPED and rng.random() < 0.5 else np.zeros(3)
    hold = free.hold(s, kind, axis=axis, pivot=pivot)
    away = _direction(rng)
    if rng.random() < 0.3:
        room = hold.room(-away)
        move = room * (1 - 10 ** rng.uniform(-4.5, -0.3)) if math.isfinite(room) and room > 0 else 0.0
    else:
        move = _size(rng, 1e-4, 0.3) * s
    turn = so3.exp(_direction(rng) * _size(rng, 1e-4, 0.4) * (rng.random() < 0.5))
    return hold.seen_from(Pose(turn, move * away).inverse())
