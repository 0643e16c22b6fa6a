"""Cells of docs/failure_policy.md that the mission never sees: what only serves people never touches flight."""

import dataclasses
import errno
from collections.abc import Callable
from pathlib import Path

import pytest

from arm_companion.clock import run_simulated
from arm_companion.config.parameters import PARAMETERS, When
from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import Facts
from arm_companion.mission.failure_policy import SITUATIONS
from arm_companion.mission.mission import step
from arm_companion.mission.parameters import Parameters
from arm_companion.mission.state import Phase
from arm_companion.record.file_recorder import FileRecorder
from arm_companion.record.mcap_file import McapFile
from arm_companion.record.recorder import Record
from tests.unit.mission_rig import BENT, HELD, T0, memory
from tests.unit.test_daemon_services import config, running

Hovering = Callable[..., Facts]


def full(path: Path, about: dict[str, str]) -> McapFile:
    raise OSError(errno.ENOSPC, "No space left on device", str(path))


@pytest.mark.parametrize("situation", SITUATIONS)
def test_a_full_disk_costs_records_and_nothing_else(
    situation: str, parameters: Parameters, hovering: Hovering, tmp_path: Path
) -> None:
    recorder = FileRecorder(tmp_path / "r.mcap", parameters.config.record, {}, lambda t: t, open_file=full)
    for phase in SITUATIONS[situation]:
        facts = hovering(BENT if phase in HELD else (0.0, 0.0))
        state, commands = step(memory(phase), facts, T0 + 0.01, parameters)
        for _ in range(20):
            recorder.put(Record(T0 + 0.01, facts, state, commands))
    recorder.close()
    assert recorder.dropped > 0


def test_nothing_that_flight_depends_on_changes_while_the_arm_is_at_work(tmp_path: Path) -> None:
    async def main() -> None:
        async with running(config(tmp_path)) as (daemon, *_):
            settings, before = daemon._settings, daemon._parameters.config
            for phase in Phase:
                daemon._state = dataclasses.replace(daemon._state, phase=phase)
                for parameter in PARAMETERS:
                    if parameter.when is not When.STOWED or phase in {Phase.STARTUP, Phase.STOWED}:
                        continue
                    with pytest.raises(CommandRejected, match=phase.name):
                        settings.set(parameter, 0.999 * parameter.read(before) or 0.001)
                assert daemon._parameters.config == before

    run_simulated(main())


def test_what_may_change_at_any_time_is_telemetry_alone() -> None:
    assert {parameter.path.split(".")[0] for parameter in PARAMETERS if parameter.when is When.NOW} <= {"rates"}
