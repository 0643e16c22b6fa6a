"""Many perches in worlds that differ from what the controller believes: how often it works, and why it does not.

A trial is drawn from its seed alone, so that a failure is flown again with `--trials 1 --seed N`.
"""

import collections
import dataclasses
import logging
import math
import multiprocessing
import os
import random
import re
import statistics
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from statistics import NormalDist

from arm_companion.clock import run_simulated
from arm_companion.config import Config, load
from arm_companion.errors import ArmError, ConfigError, in_words, place
from arm_companion.sim.judges import SCENARIOS
from arm_companion.sim.orphans import end_with_parent
from arm_companion.sim.runner import fly_simulated

MODEL_ERROR = 0.1
"""Greatest relative difference between the plant and the controller's parameters."""

_BAR_MOVED_M = (0.5, 0.5, 0.2)  # where the bar is: told to the daemon
_BAR_TURNED_DEG = 20.0
_BAR_ERROR_M = 0.01  # by how much what it is told is wrong, each axis
_BAR_ERROR_DEG = 2.0
_WIND_M_PER_S = 2.0
_MASS_SHARE = (0.75, 1.5)  # of the configured object's
_CONFIDENCE = 0.95
_HARM = (
    "airframe",
    "propeller",
    "did not land",
    "the hanging vehicle",
    "the vehicle fell",
    "the vehicle lies",
    "the object fell",
)
_OVER = 1.05  # of the tension limit, from which the plant's truth counts as a limit broken: the servos' own overshoot


@dataclass(frozen=True)
class Draw:
    """One trial's differences.

    Attributes:
        controller: what the daemon is given.
        world: how the plant is.
        words: the differences for people.
    """

    controller: Config
    world: Config
    words: str


@dataclass(frozen=True)
class Outcome:
    """What became of one trial."""

    seed: int
    success: bool
    reason: str
    harm: str  # a limit broken, the airframe touched or the vehicle fell; empty: none
    words: str
    covered: float = math.nan
    """Share of the held arm's predicted forces within two sigma of the truth; nan: it never held."""


@dataclass(frozen=True)
class Summary:
    """What became of all."""

    outcomes: tuple[Outcome, ...]

    @property
    def success(self) -> int:
        """How many succeeded."""
        return sum(outcome.success for outcome in self.outcomes)

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of the share of successes."""
        return wilson(self.success, len(self.outcomes))

    @property
    def failures(self) -> dict[str, int]:
        """How often each reason ended a trial, the most frequent first; figures in reasons are left out."""
        return dict(collections.Counter(kind(o.reason) for o in self.outcomes if not o.success).most_common())

    @property
    def covered(self) -> float:
        """Mean share of the held arm's predicted forces within two sigma of the truth; nan: it never held."""
        shares = [outcome.covered for outcome in self.outcomes if not math.isnan(outcome.covered)]
        return statistics.fmean(shares) if shares else math.nan

    @property
    def harmed(self) -> int:
        """How many trials broke a limit, touched with the airframe or fell."""
        return sum(bool(outcome.harm) for outcome in self.outcomes)


def wilson(successes: int, trials: int, confidence: float = _CONFIDENCE) -> tuple[float, float]:
    """Wilson's score interval of a share (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927).

    Args:
        successes: how many.
        trials: of how many.
        confidence: that the true share lies inside.

    Raises:
        ValueError: more successes than trials, or negative ones.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials")
    if trials == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + confidence / 2.0)
    share = successes / trials
    scale = 1.0 + z**2 / trials
    middle = (share + z**2 / (2.0 * trials)) / scale
    half = z / scale * math.sqrt(share * (1.0 - share) / trials + z**2 / (4.0 * trials**2))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def kind(reason: str) -> str:
    """A reason without its figures, so that two of a kind count as one."""
    return re.sub(r"-?\d+(\.\d+)?", "…", reason)


def draw(config: Config, seed: int) -> Draw:
    """The worlds of one trial.

    The controller keeps its own parameters of arm and vehicle; it is told where the bar is, with an error.
    """
    rng = random.Random(seed)  # noqa: S311 - repeatable by design

    def within(most: float) -> float:
        return rng.uniform(-most, most)

    def off() -> float:
        return 1.0 + within(MODEL_ERROR)

    replace = dataclasses.replace
    bar, perch, arm = config.sim.bar, config.perch, config.arm
    moved, turned = [within(most) for most in _BAR_MOVED_M], within(_BAR_TURNED_DEG)
    told = [within(_BAR_ERROR_M) for _ in range(3)]
    speed, heading = _WIND_M_PER_S * math.sqrt(rng.random()), within(math.pi)
    wind = (speed * math.cos(heading), speed * math.sin(heading), 0.0)
    share = {name: off() for name in ("EI", "k_T", "friction", "arm mass", "vehicle mass")}
    sim = replace(
        config.sim,
        seed=seed,
        wind_m_per_s=tuple(a + b for a, b in zip(config.sim.wind_m_per_s, wind, strict=True)),
        bar=replace(
            bar,
            position_m=tuple(a + b for a, b in zip(bar.position_m, moved, strict=True)),
            axis_deg=bar.axis_deg + turned,
            friction=bar.friction * share["friction"],
        ),
    )
    controller = replace(
        config,
        sim=sim,
        perch=replace(
            perch,
            bar_position_m=tuple(a + b + e for a, b, e in zip(perch.bar_position_m, moved, told, strict=True)),
            bar_axis_deg=perch.bar_axis_deg + turned + within(_BAR_ERROR_DEG),
        ),
    )
    backbone, tendons, mass = arm.backbone, arm.tendons, arm.mass
    world = replace(
        controller,
        vehicle=replace(config.vehicle, mass_kg=config.vehicle.mass_kg * share["vehicle mass"]),
        arm=replace(
            arm,
            backbone=replace(backbone, youngs_modulus_pa=backbone.youngs_modulus_pa * share["EI"]),
            tendons=replace(
                tendons,
                youngs_modulus_pa=tendons.youngs_modulus_pa * share["k_T"],
                servo_stiffness_n_per_m=tendons.servo_stiffness_n_per_m * share["k_T"],
            ),
            mass=replace(
                mass,
                disk_kg=mass.disk_kg * share["arm mass"],
                end_disk_kg=mass.end_disk_kg * share["arm mass"],
                backbone_density_kg_m3=mass.backbone_density_kg_m3 * share["arm mass"],
            ),
        ),
    )
    if config.sim.object.mass_kg:
        controller, world = (_with_object(one, config, _others(seed)) for one in (controller, world))
        if given := config.sim.object.friction:
            share["friction"] = world.sim.object.friction / given
    words = ", ".join(f"{name} {100 * (value - 1):+.0f} %" for name, value in share.items())
    name = "bar"
    if (thing := world.sim.object).mass_kg:
        told = [a - b for a, b in zip(controller.grasp.object_position_m, thing.position_m, strict=True)]
        name = f"object of {1e3 * thing.mass_kg:.0f} g"
    error = "/".join(f"{1e3 * e:+.0f}" for e in told)
    return Draw(controller, world, f"{words}, wind {speed:.1f} m/s, {name} told {error} mm off")


def _others(seed: int) -> random.Random:
    """Numbers of a trial that are drawn for an object, apart from those that every trial draws."""
    return random.Random(f"object {seed}")  # noqa: S311 - repeatable by design


def _with_object(one: Config, config: Config, rng: random.Random) -> Config:
    """The same object elsewhere and of another weight, both in the world and, with an error, in what is told of it.

    Args:
        one: configuration of the controller or of the world; both are drawn alike.
        config: before anything was drawn.
        rng: of this trial, afresh.
    """
    replace = dataclasses.replace
    thing, grasp = config.sim.object, config.grasp
    moved = [rng.uniform(-most, most) for most in _BAR_MOVED_M]
    told = [rng.uniform(-_BAR_ERROR_M, _BAR_ERROR_M) for _ in range(3)]
    turned, misread = rng.uniform(-_BAR_TURNED_DEG, _BAR_TURNED_DEG), rng.uniform(-_BAR_ERROR_DEG, _BAR_ERROR_DEG)
    friction = thing.friction * (1.0 + rng.uniform(-MODEL_ERROR, MODEL_ERROR))
    thing = replace(
        thing,
        mass_kg=thing.mass_kg * rng.uniform(*_MASS_SHARE),
        friction=friction,
        position_m=tuple(a + b for a, b in zip(thing.position_m, moved, strict=True)),
        axis_deg=thing.axis_deg + turned,
    )
    grasp = replace(
        grasp,
        object_position_m=tuple(a + b + e for a, b, e in zip(grasp.object_position_m, moved, told, strict=True)),
        object_axis_deg=grasp.object_axis_deg + turned + misread,
    )
    return replace(one, grasp=grasp, sim=replace(one.sim, object=thing))


def fly_one(file: str, settings: tuple[str, ...], seed: int, scenario: str = "perch") -> Outcome:
    """One trial in simulated time, in this process.

    Args:
        file: configuration, read anew because a read one does not travel between processes.
        settings: options that override it.
        seed: of the trial.
        scenario: which flight.

    Raises:
        ConfigError: the configuration cannot be used.
    """
    logging.getLogger("arm_companion").addHandler(logging.NullHandler())  # the outcome says it, with its seed
    config = load(file, settings, os.environ)
    drawn = draw(config, seed)
    script = SCENARIOS[scenario]
    fly = script.fly_trial or script.fly
    try:
        result = run_simulated(fly_simulated(drawn.controller, lambda _: None, world=drawn.world, fly=fly))
    except ConfigError:  # the other trials would have it too
        raise
    except Exception as error:  # noqa: BLE001 - such as physics that diverge: this world's failure, and no other's
        return Outcome(seed, False, _in_words(error), "", drawn.words)
    verdict = script.judge(result.flight, result.failure, drawn.world)
    samples = result.flight.samples
    most = max((max(sample.truth.tension) for sample in samples), default=0.0)
    harm = [reason for reason in verdict.reason.split("; ") if any(word in reason for word in _HARM)]
    if most > _OVER * config.limits.tension_max_n:
        harm.append(f"a tendon carried {most:.1f} N")
    covered = verdict.held.covered if verdict.held else math.nan
    return Outcome(seed, verdict.success, verdict.reason, "; ".join(harm), drawn.words, covered)


def _in_words(error: Exception) -> str:
    """What ended a flight, of a group the first one."""
    first: BaseException = error
    while isinstance(first, BaseExceptionGroup):
        first = first.exceptions[0]
    return str(first) if isinstance(first, ArmError) else f"{in_words(first)} ({place(first)})"


def fly(
    file: str,
    settings: Sequence[str],
    seeds: Sequence[int],
    jobs: int,
    told: Callable[[Outcome], None] = lambda _: None,
    scenario: str = "perch",
) -> Summary:
    """All trials, each in a process of `jobs`.

    Args:
        file: configuration of every trial, before it is drawn.
        settings: options that override it.
        seeds: one for each trial.
        jobs: processes that fly at the same time.
        told: called with each outcome as it comes, in any order.
        scenario: which flight.

    Raises:
        BrokenProcessPool: a process died.
    """
    spawn = multiprocessing.get_context("spawn")
    outcomes: list[Outcome] = []
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(min(jobs, len(seeds)), mp_context=spawn, initializer=end_with_parent) as pool:
        waiting = [pool.submit(fly_one, file, tuple(settings), seed, scenario) for seed in seeds]
        try:
            for done in as_completed(waiting):
                outcomes.append(done.result())
                told(outcomes[-1])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for ours in set(multiprocessing.active_children()) - others:  # the flights under way would be waited for
                ours.terminate()
            raise
    return Summary(tuple(sorted(outcomes, key=lambda outcome: outcome.seed)))
