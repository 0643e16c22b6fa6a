"""The daemon's part of a calibration that the ground orders: winding within limits, storing, and taking into use."""

import asyncio
import dataclasses
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from arm_companion.config import Config, load
from arm_companion.drivers import calibration_files as files
from arm_companion.drivers import recalibration
from arm_companion.drivers.calibrated import Calibrated
from arm_companion.drivers.calibration import TendonCalibration
from arm_companion.drivers.recalibration import Recalibration
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.servo_setup import ServoInfo
from arm_companion.errors import DeviceFault
from arm_companion.mission.facts import Order, Request
from arm_companion.mission.state import Phase
from arm_companion.procedures.tendon_zeros import Zero

ZEROS = tuple(Zero(100 * i, 0.0004, 5.0, 30.0) for i in (1, 2, 3, 4))
OTHERS = tuple(Zero(7, 0.0004, 5.0, 30.0) for _ in range(4))
FAR = (90_000, 2048, -500, 2100)  # ticks; the first has been wound up by 21 turns since anybody set its zero


def servos(positions: Sequence[int] = FAR, load: float = 0.0) -> tuple[ServoState, ...]:
    return tuple(
        ServoState(i + 1, p, 0.0, load, 12.0, 30.0, 0, True, False, False, True, False, 0.0)
        for i, p in enumerate(positions)
    )


class Bus:
    """As much of a servo bus as is asked."""

    def __init__(self, config: Config) -> None:
        self.info = {i: ServoInfo(i, 1060, 46, 0, 0, fresh=False) for i in config.servos.ids}
        self.zeros: tuple[int, ...] = ()

    def renew_zeros(self, zeros: tuple[int, ...]) -> None:
        self.zeros = zeros

    async def limp(self) -> None:
        raise ExceptionGroup("torque off", [DeviceFault(3, 0, "does not answer")])


class Desk:
    """A recalibration and its state directory."""

    def __init__(self, directory: Path) -> None:
        self.config = load("sim.toml", (f"calibration.directory={directory}",))
        self.file = directory / files.TENDONS
        self.calibrated = Calibrated(self.config, 0.0)
        self.bus = Bus(self.config)
        self.renewed = 0
        self.own = Recalibration(self.config, self.calibrated, self.bus, self.renew)  # type: ignore[arg-type]

    def renew(self) -> None:
        self.renewed += 1

    def store(self, zeros: tuple[Zero, ...], phase: Phase) -> str | None:
        """What the mission hears of it, in `phase` when it is done."""
        self.own.facts(servos(), (), Phase.CALIBRATING)
        self.own.store(zeros, 1.0e9)
        writing = self.own._writing
        assert writing is not None
        writing.exception(5.0)
        workshop = self.own.facts(servos(), (), phase)
        return None if workshop is None else workshop.kept

    def stored(self) -> list[int] | None:
        self.own.close()
        found = files.tendons(str(self.file.parent))
        return [t.zero_ticks for t in found.tendons] if isinstance(found, TendonCalibration) else None


def test_a_result_is_stored_and_used_at_once_and_the_next_one_is_counted_from_it(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    assert desk.store(ZEROS, Phase.CALIBRATING) == ""
    assert desk.store(OTHERS, Phase.CALIBRATING) == ""
    wanted = [2048 + 100 * i + 7 for i in (1, 2, 3, 4)]
    assert desk.stored() == wanted
    assert (list(desk.calibrated.servos.zero_ticks), list(desk.bus.zeros), desk.renewed) == (wanted, wanted, 2)
    assert Calibrated(desk.config, 0.0).servos.zero_ticks == tuple(wanted), "and at the next start"


@pytest.mark.parametrize("before", [(), ZEROS])
def test_one_that_is_stored_after_it_was_given_up_is_taken_back(before: tuple[Zero, ...], tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    if before:
        assert desk.store(before, Phase.CALIBRATING) == ""
    zeros = desk.calibrated.servos.zero_ticks
    assert desk.store(OTHERS, Phase.EASING) != ""
    assert desk.calibrated.servos.zero_ticks == zeros
    assert desk.stored() == (list(zeros) if before else None)


def test_while_it_is_written_nothing_is_said_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, save = threading.Event(), files.save

    def slow(path: Path, value: object) -> None:
        go_on.wait(5.0)
        save(path, value)

    monkeypatch.setattr(recalibration.files, "save", slow)
    desk = Desk(tmp_path)
    desk.own.facts(servos(), (), Phase.CALIBRATING)
    desk.own.store(ZEROS, 0.0)
    workshop = desk.own.facts(servos(), (), Phase.CALIBRATING)
    assert workshop is not None
    assert (workshop.kept, desk.renewed) == (None, 0)
    go_on.set()
    assert desk.stored() is not None


def test_the_mission_hears_of_it_only_while_it_wants_to_know(tmp_path: Path) -> None:
    desk, ask = Desk(tmp_path), Request(1, Order.CALIBRATE)
    assert desk.own.facts(servos(), (), Phase.STOWED) is None
    assert desk.own.facts(servos(), (Request(1, Order.READY),), Phase.STOWED) is None
    assert desk.own.facts(servos(), (ask,), Phase.STOWED) is not None
    assert desk.own.facts(servos(), (), Phase.EASING) is not None
    nowhere = dataclasses.replace(desk.config, calibration=dataclasses.replace(desk.config.calibration, directory=""))
    own = Recalibration(nowhere, desk.calibrated, desk.bus)  # type: ignore[arg-type]
    assert own.facts(servos(), (ask,), Phase.STOWED) is None


def test_limits_on_displacement_and_speed_count_from_where_the_winding_began(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    limits = desk.config.limits
    pulls = [state.pull for state in desk.calibrated.tendons(desk.config).states(servos())]
    desk.own.facts(servos(), (), Phase.STOWED)
    assert desk.own.goals(pulls, limits, 0.0) == FAR, "wherever that is"
    m_per_tick = desk.own.facts(servos(), (), Phase.CALIBRATING).m_per_tick  # type: ignore[union-attr]
    first = desk.own.goals([pull + 1.0 for pull in pulls], limits, 0.01)
    fastest = limits.pull_speed_m_per_s * 0.01 / m_per_tick
    assert [goal - origin for goal, origin in zip(first, FAR, strict=True)] == pytest.approx([fastest] * 4, abs=1)
    for cycle in range(2, 400):
        last = desk.own.goals([pull + 1.0 for pull in pulls], limits, 0.01 * cycle)
    farthest = limits.pull_max_m / m_per_tick
    assert [goal - origin for goal, origin in zip(last, FAR, strict=True)] == pytest.approx([farthest] * 4, abs=1)


def test_a_tendon_that_is_too_tight_is_let_out_and_a_slack_one_may_be(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    limits = desk.config.limits
    for share in (0.6, 0.0):
        desk.own.facts(servos(load=share), (), Phase.STOWED)
        pulls = [state.pull for state in desk.calibrated.tendons(desk.config).states(servos())]
        wanted = [pull + (0.01 if share else -0.01) for pull in pulls]
        begin = desk.own.goals(pulls, limits, 0.0)
        after = desk.own.goals(wanted, limits, 0.1)
        assert [a < b for a, b in zip(after, begin, strict=True)] == [True] * 4


def test_a_servo_that_does_not_let_go_ends_no_cycle(tmp_path: Path) -> None:
    asyncio.run(Desk(tmp_path).own.let_go())
