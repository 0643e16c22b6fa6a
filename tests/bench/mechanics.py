"""The rod's warm clamped solve beside the arc, shooting and a settling chain; the arc beside the printed formulas."""

import importlib.util
import itertools
import math
from collections.abc import Iterator

import numpy as np

from arm_companion.arm import arc
from arm_companion.arm.arc_model import ArcModel
from arm_companion.arm.model import ArmModel, ArmSolution, Hold, HoldKind
from arm_companion.arm.parameters import ArmParameters, Guides
from arm_companion.arm.rod_model import RodModel
from arm_companion.config import load
from arm_companion.geometry.se3 import Pose
from tests.bench.measure import Result, medians
from tests.bench.settle import SettlingChain
from tests.bench.shooting import ShootingSolver

GRAVITY = np.array((0.0, 0.0, 9.81))
BEND = np.array((math.radians(30), 0.0))
FINE = 40  # links of the chain that is the truth
LAPS = 200  # positions of the base on its way: a lap takes 2 s of flight at 100 Hz


def path() -> list[np.ndarray]:
    """Moves of the base about a perch: a centimetre towards and along, a millimetre across, never taut."""
    turn = np.linspace(0.0, 2 * math.pi, LAPS, endpoint=False)
    return [np.array((5e-3 * (1 - math.cos(a)), 1e-3 * math.sin(2 * a), 1e-3 * math.sin(a))) for a in turn]


class WarmSolver:
    """A model that follows the base along the path, each answer the start of the next."""

    def __init__(self, model: ArmModel, pull: np.ndarray) -> None:
        self.model, self.pull = model, pull
        self.hold = model.free(pull, GRAVITY).hold(model.parameters.L, HoldKind.CLAMPED)
        self.last: ArmSolution | None = None
        self.way = itertools.cycle([self.seen(move) for move in path()])

    def under(self, hold: Hold) -> ArmSolution:
        self.last = self.model.held(self.pull, hold, GRAVITY, start=self.last)
        return self.last

    def at(self, move: np.ndarray) -> ArmSolution:
        return self.under(self.seen(move))

    def seen(self, move: np.ndarray) -> Hold:
        return self.hold.seen_from(Pose(np.eye(3), -move))

    def step(self) -> ArmSolution:
        return self.under(next(self.way))


def mechanics(rounds: int) -> Iterator[Result]:
    config = load("zhao2022.toml")
    smooth = ArmParameters.of(config.arm, Guides.CONTINUOUS)
    rod = RodModel(smooth)
    pull = rod.pull_for_bend(BEND)
    warm, one_arc = WarmSolver(rod, pull), WarmSolver(ArcModel(smooth), pull)
    shooting = ShootingSolver(smooth, pull, GRAVITY, rod.free(pull, GRAVITY))
    way = itertools.cycle([warm.seen(move) for move in path()])

    def shoot() -> np.ndarray:
        hold = next(way)
        return shooting.solve(hold.pose.position, hold.pose.rotation)

    chain = SettlingChain(config, pull)
    settled = itertools.cycle(path())
    solve = "rod, warm clamped solve, "
    times = medians(
        rounds,
        (warm.step, LAPS, 1),
        (one_arc.step, LAPS, 1),
        (shoot, 3, 1),
        (lambda: chain.solve(next(settled)), 6, 1),
    )
    ours, arc_s, shooting_s, chain_s = (1e3 * t for t in times)
    yield Result(solve + "NumPy", ours, "ms", "one arc, same question", arc_s)
    yield Result(solve + "NumPy", ours, "ms", "shooting, SciPy", shooting_s)
    yield Result(solve + "NumPy", ours, "ms", "MuJoCo chain, left to settle", chain_s)
    if importlib.util.find_spec("numba") is not None:
        quick = WarmSolver(RodModel(smooth, fast=True), pull)
        fast, shooting_s = (1e3 * t for t in medians(rounds, (quick.step, LAPS, 1), (shoot, 3, 1)))
        yield Result(solve + "numba", fast, "ms", "rod, NumPy", ours)
        yield Result(solve + "numba", fast, "ms", "shooting, SciPy", shooting_s)
    yield from _accuracy(warm, one_arc, shooting)
    yield from _against_chain()
    yield from _arc(rounds, smooth)


def _accuracy(warm: WarmSolver, one_arc: WarmSolver, shooting: ShootingSolver) -> Iterator[Result]:
    """Largest error of the force on the carrier along the path, over the largest force."""
    moves = path()[::20]
    truth = []
    for move in moves:
        hold = warm.seen(move)
        truth.append(shooting.solve(hold.pose.position, hold.pose.rotation)[:3].copy())
    rod = _error([warm.at(m).base_wrench[:3] for m in moves], truth)
    arcs = _error([one_arc.at(m).base_wrench[:3] for m in moves], truth)
    yield Result("rod, force on the carrier, against shooting", rod, "%", "one arc", arcs)


def _against_chain() -> Iterator[Result]:
    """The same against a chain of links: a fine one, for a hinge at every disk of ten is 1 to 3 % off a rod itself."""
    moves = path()[::20]
    config = load("zhao2022.toml", [f"arm.disks={FINE}", f"arm.mass.disk_kg={0.027 / (FINE - 1)}"])
    smooth, disks = (RodModel(ArmParameters.of(config.arm, guides)) for guides in (Guides.CONTINUOUS, Guides.DISKS))
    pull = smooth.pull_for_bend(BEND)
    chain = SettlingChain(config, pull)
    links = [chain.solve(m)[:3] for m in moves]
    real, ideal = WarmSolver(disks, pull), WarmSolver(smooth, pull)
    with_disks = _error([real.at(m).base_wrench[:3] for m in moves], links)
    without = _error([ideal.at(m).base_wrench[:3] for m in moves], links)
    yield Result(f"rod with disks, against {FINE} links in MuJoCo", with_disks, "%", "rod, continuous guides", without)


def _error(found: list[np.ndarray], truth: list[np.ndarray]) -> float:
    off = max(float(np.linalg.norm(a - b)) for a, b in zip(found, truth, strict=True))
    return 100 * off / max(float(np.linalg.norm(t)) for t in truth)


def _arc(rounds: int, parameters: ArmParameters) -> Iterator[Result]:
    L = parameters.L
    bends = itertools.cycle([np.array((t * math.cos(a), t * math.sin(a))) for t in (0.1, 0.6, 1.5) for a in (0.2, 2.0)])

    def ours() -> object:
        u = next(bends)
        return arc.tip_position(u, L), arc.tip_rotation(u), arc.jacobian(u, L), parameters.H @ u

    def printed() -> object:
        x, y = next(bends)
        return _printed(math.hypot(x, y), math.atan2(y, x), L, parameters.r)

    mine, theirs = (1e6 * t for t in medians(rounds, (ours, 5, 600), (printed, 5, 600)))
    yield Result("arc, kinematics and Jacobians", mine, "us", "the printed formulas, NumPy", theirs)


def _printed(theta: float, delta: float, L: float, r: float) -> tuple[np.ndarray, ...]:
    """The paper's eqs. 1 to 10 as they stand: transforms, tendon displacements and three Jacobians."""
    t, c, s = theta, math.cos(theta), math.sin(theta)
    cd, sd = math.cos(delta), math.sin(delta)
    k = np.arange(4) * math.pi / 2 + delta

    def rot_z(a: float) -> np.ndarray:
        T = np.eye(4)
        T[:2, :2] = ((math.cos(a), -math.sin(a)), (math.sin(a), math.cos(a)))
        return T

    bend = np.array(((c, 0, s, L / t * (1 - c)), (0, 1, 0, 0), (-s, 0, c, L / t * s), (0, 0, 0, 1)))
    T = rot_z(delta) @ bend @ rot_z(-delta)
    q = r * np.cos(k) * t
    J_q = np.column_stack((r * np.cos(k), -r * np.sin(k) * t))
    J_v = L * np.array(
        (
            (cd * (t * s + c - 1) / t**2, -sd * (1 - c) / t),
            (sd * (t * s + c - 1) / t**2, cd * (1 - c) / t),
            ((t * c - s) / t**2, 0.0),
        )
    )
    J_omega = np.array(((-sd, -cd * s), (cd, -sd * s), (0.0, 1 - c)))
    return T, q, J_q, J_v, J_omega
