"""The paper's perching benchmark: what a carrier feels that moves while the arm's tip is held.

The arm, bent by 30 deg, has its tip in a vise; its carrier travels 10 mm along x of the base and back at constant
speed, then the same along z. A force sensor between carrier and arm reads force and torque. The model is
quasi-static; time is travel over speed. The paper prints neither speed nor numbers.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arm_companion.arm.model import ArmSolution, HoldKind
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.errors import ModelError
from arm_companion.experiments.case import Case, goals
from arm_companion.geometry.arrays import ArrayLike

BEND_DEG = 30.0
TRAVEL = 0.01
SPEED = 0.002
STEP = 0.00025
AXES = {"x": 0, "z": 2}
_STILL = 1e-3  # N, a change of tension that no guide holds back


@dataclass(frozen=True)
class Sample:
    """One position of the carrier.

    Attributes:
        axis: of the travel, "x" or "z" of the base.
        time: since the travel began, s.
        travel: along the axis, m; positive z is towards the vise.
        force: on the carrier, N, base axes.
        torque: on the carrier at the base point, N m, base axes.
        tip_force: of the vise on the tip, N, base axes.
        tip_moment: of the vise on the tip, N m, base axes.
        tension: of each tendon, N.
        taut_margin: how much farther the base could be from the tip, m.
        residual: of the equilibrium.
    """

    axis: str
    time: float
    travel: float
    force: tuple[float, ...]
    torque: tuple[float, ...]
    tip_force: tuple[float, ...]
    tip_moment: tuple[float, ...]
    tension: tuple[float, ...]
    taut_margin: float
    residual: float


@dataclass(frozen=True)
class Travel:
    """There and back along one axis.

    Attributes:
        axis: "x" or "z".
        samples: in the order of time.
        refusal: why it ends early; empty when it does not.
    """

    axis: str
    samples: tuple[Sample, ...]
    refusal: str = ""

    @property
    def largest_force(self) -> float:
        """Greatest magnitude of the change of force since the start, N."""
        start = np.array(self.samples[0].force)
        return max(float(np.sqrt(((np.array(s.force) - start) ** 2).sum())) for s in self.samples)

    @property
    def largest_torque(self) -> float:
        """Greatest magnitude of the change of torque since the start, N m."""
        start = np.array(self.samples[0].torque)
        return max(float(np.sqrt(((np.array(s.torque) - start) ** 2).sum())) for s in self.samples)

    @property
    def mismatch(self) -> float:
        """Largest difference of the force on the way back from that on the way out, N."""
        out: dict[int, Sample] = {}
        worst = 0.0
        for s in self.samples:
            place = round(s.travel / 1e-9)
            there = out.setdefault(place, s)
            worst = max(worst, *(abs(a - b) for a, b in zip(s.force, there.force, strict=True)))
        return worst


def run(
    parameters: ArmParameters,
    *,
    bend_deg: float = BEND_DEG,
    travels: Sequence[tuple[str, float]] = (("x", TRAVEL), ("z", TRAVEL)),
    gravity: ArrayLike = (0.0, 0.0, 0.0),
    kind: HoldKind = HoldKind.CLAMPED,
    speed: float = SPEED,
    step: float = STEP,
) -> list[Travel]:
    """The benchmark.

    Args:
        parameters: the arm, one segment.
        bend_deg: commanded, in the plane delta = 0.
        travels: axis and signed distance, m.
        gravity: (3,), m/s^2, base axes.
        kind: how the tip is held where it hangs free.
        speed: of the carrier, m/s.
        step: distance between samples, m.

    Raises:
        ModelError: when not even the arm at rest has a solution.
    """
    model = RodModel(parameters)
    case = Case(model, goals(parameters, bend_deg), np.asarray(gravity, dtype=np.float64))
    unloaded = case.free()
    return [_travel(case, unloaded, axis, distance, kind, speed, step) for axis, distance in travels]


def _travel(
    case: Case, unloaded: ArmSolution, axis: str, distance: float, kind: HoldKind, speed: float, step: float
) -> Travel:
    count = max(1, round(abs(distance) / step))
    samples: list[Sample] = []
    covered, here, now = 0.0, 0.0, None
    try:
        for k in itertools.chain(range(count + 1), range(count - 1, -1, -1)):
            travel = distance * k / count
            covered, here = covered + abs(travel - here), travel
            move = np.zeros(3)
            move[AXES[axis]] = travel
            now = case.held(move.tolist(), kind, unloaded=unloaded, start=now)
            samples.append(_sample(axis, covered / speed, travel, now))
    except ModelError as error:
        return Travel(axis, tuple(samples), f"at {1e3 * here:g} mm: {error}")
    return Travel(axis, tuple(samples))


def _sample(axis: str, time: float, travel: float, now: ArmSolution) -> Sample:
    base, tip = now.base_wrench.tolist(), now.tip_wrench.tolist()
    return Sample(
        axis,
        time,
        travel,
        tuple(base[:3]),
        tuple(base[3:]),
        tuple(tip[:3]),
        tuple(tip[3:]),
        tuple(now.tension.tolist()),
        now.taut_margin,
        now.residual,
    )


def findings(travels: Sequence[Travel]) -> list[str]:
    """What the benchmark says beside the paper's: a smooth rise and fall of force with the travel."""
    said: list[str] = []
    swing = 0.0
    for t in travels:
        if len(t.samples) < 2:
            said.append(f"{t.axis}: ends {t.refusal}.")
            continue
        line = f"{t.axis}: force changes by up to {t.largest_force:.2f} N, torque by {t.largest_torque:.4f} N m"
        start = t.samples[0].tension
        swing = max(swing, *(abs(a - b) for s in t.samples for a, b in zip(s.tension, start, strict=True)))
        if t.refusal:
            margin = 1e3 * t.samples[-1].taut_margin
            said.append(f"{line}; {margin:.2f} mm before the backbone is straight it ends {t.refusal}.")
        else:
            said.append(
                f"{line}, and falls back smoothly, as in the paper; way out and way back differ by {t.mismatch:.0e} N."
            )
    said.append(f"tendons: tensions change by at most {swing:.1e} N.")
    if swing < _STILL:
        said.append(
            "friction: a clamped end disk keeps every tendon's path as long as it was, so no tendon slides as a whole"
            " and guide friction adds no hysteresis; a lag in a measured curve is the vise's or the backbone's own."
        )
    else:
        said.append(
            "friction: tendons slide a little, so guide friction would part the ways out and back; none is modelled."
        )
    return said
