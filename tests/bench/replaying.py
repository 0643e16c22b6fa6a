"""A cycle of the mission, and of a replay: the golden flight, each of its facts for eight cycles, at 100 Hz again."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from arm_companion.arm import compiled
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import Config
from arm_companion.config.table import as_table
from arm_companion.mission.facts import Facts
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import State
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.reader import Reader
from arm_companion.record.replay import cycles, replay
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, STATE
from arm_companion.record_codec import plain
from arm_companion.values import replace
from tests.bench.measure import Result

GOLDEN = Path(__file__).parents[1] / "golden" / "perch.mcap"
EACH = 8
PERIOD_S = 0.01


def replaying(rounds: int) -> Iterator[Result]:
    """Time of a cycle in `step` alone, and with reading and comparing; on compiled mechanics, where there are any."""
    fast = compiled.installed()
    if fast:
        compiled.load(compiling=True)
    config, flight = _flight()
    parameters = Parameters(config, RodModel(ArmParameters.of(config.arm), fast=fast))
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "flight.mcap"
        _write(path, parameters, flight, mechanics="numba" if fast else "numpy")
        steps, replays = [], []
        for _ in range(rounds):
            steps.append(_fly(parameters, flight))
            begun = time.perf_counter()
            outcome = replay(Reader(path))
            replays.append(time.perf_counter() - begun)
            assert outcome.identical
    yield Result("mission, one cycle", 1e3 * median(steps) / len(flight), "ms")
    yield Result("replay in one go, one cycle", 1e3 * median(replays) / len(flight), "ms")


def _flight() -> tuple[Config, list[tuple[float, Facts]]]:
    """The configuration, and the facts of every cycle with its time."""
    config, flight = Config(), []
    for found in cycles(Reader(GOLDEN)):
        if isinstance(found, Config):
            config = found
            continue
        flight += [(found.t, found.facts)]
        flight += [(found.t + k * PERIOD_S, replace(found.facts, requests=())) for k in range(1, EACH)]
    return config, flight


def _fly(parameters: Parameters, flight: list[tuple[float, Facts]]) -> float:
    state = State()
    begun = time.perf_counter()
    for t, facts in flight:
        state, _ = step(state, facts, t, parameters)
    return time.perf_counter() - begun


def _write(path: Path, parameters: Parameters, flight: list[tuple[float, Facts]], mechanics: str) -> None:
    file = McapFile(path, {**Reader(GOLDEN).versions, "mechanics": mechanics})
    file.json(CONFIGURATION, 0, {"t": 0.0, "config": as_table(parameters.config)})
    state = State()
    for number, (t, facts) in enumerate(flight):
        file.json(STATE, 0, plain(state), number)
        state, commands = step(state, facts, t, parameters)
        file.json(FACTS, 0, {"t": t} | plain(facts), number)
        file.json(COMMANDS, 0, {"t": t} | plain(commands), number)
    file.close()
