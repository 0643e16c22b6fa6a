"""Makes a golden flight of a record: every n-th cycle's facts, and what the code of today commands on them.

    python -m tests.golden.thin RECORD GOLDEN [N]

The orders of the cycles left out come with the next one that stays, and the configuration says the lower rate.
Mechanics run on NumPy, which every machine has.
"""

import dataclasses
import sys
from pathlib import Path

from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.config.schema import Config
from arm_companion.config.table import as_table
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import State
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.reader import Reader
from arm_companion.record.replay import cycles
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, STATE
from arm_companion.record.versions import versions
from arm_companion.record_codec import plain


def thin(source: Path, target: Path, every: int) -> int:
    """Write the golden flight; returns its cycles."""
    file = McapFile(target, {**versions(Config()), "mechanics": "numpy", "part": "1", "begun": "0"})
    state, parameters, requests, count = State(), None, [], 0
    for i, cycle in enumerate(cycles(Reader(source))):
        if isinstance(cycle, Config):
            rates = dataclasses.replace(cycle.rates, cycle_hz=cycle.rates.cycle_hz / every)
            config = dataclasses.replace(cycle, rates=rates)
            parameters = Parameters(config, RodModel(ArmParameters.of(config.arm)))
            file.json(CONFIGURATION, 0, {"t": 0.0, "config": as_table(config)})
            continue
        requests += cycle.facts.requests
        if i % every:
            continue
        assert parameters is not None
        facts, requests = dataclasses.replace(cycle.facts, requests=tuple(requests)), []
        ns = round(cycle.t * 1e9)
        if count == 0:
            file.json(STATE, ns, plain(state), count)
        state, commands = step(state, facts, cycle.t, parameters)
        file.json(FACTS, ns, {"t": cycle.t} | plain(facts), count)
        file.json(COMMANDS, ns, {"t": cycle.t} | plain(commands), count)
        count += 1
    file.close()
    return count


if __name__ == "__main__":
    number = int(sys.argv[3]) if len(sys.argv) > 3 else 5
    print(thin(Path(sys.argv[1]), Path(sys.argv[2]), number), "cycles")  # noqa: T201 - a command prints
