"""The whole daemon, without servos: what comes in by MAVLink reaches configuration, facts and its own end."""

import asyncio
import contextlib
import dataclasses
import json
import math
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from arm_companion.app import Daemon, Openers
from arm_companion.clock import SIMULATED_EPOCH_S, Clock, run_simulated
from arm_companion.config import Config, load
from arm_companion.config.schema import LinkConfig, MavlinkConfig
from arm_companion.drivers.settings import FILE, with_kept_changes
from arm_companion.drivers.standard_services import Power
from arm_companion.errors import ConfigError
from arm_companion.mission.facts import SetpointKind
from arm_companion.mission.state import Phase
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import MavlinkCodec
from arm_companion.protocol.tunnel import tunnel
from arm_companion.record.recorder import MemoryRecorder
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.memory import MemoryPipe
from tests.conftest import MavlinkPeer
from tests.unit.component_rig import GCS

NAN = math.nan


def config(directory: Path) -> Config:
    return dataclasses.replace(load("sim.toml"), mavlink=MavlinkConfig(state_directory=str(directory)))


@contextlib.asynccontextmanager
async def running(settings: Config) -> AsyncIterator[tuple[Daemon, MavlinkPeer, MavlinkPeer, MemoryRecorder, Any]]:
    peers = {"autopilot": MavlinkPeer(1, 1), "ground": MavlinkPeer(255, 190)}
    recorder = MemoryRecorder()
    openers = Openers({name: peer.pipe.opener(0) for name, peer in peers.items()}, MemoryPipe().opener(0))
    clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
    daemon = Daemon(settings, openers, clock, ServiceManager(""), recorder)
    for peer in peers.values():
        await peer.open()
    task = asyncio.create_task(daemon.run(asyncio.Event()))
    await asyncio.sleep(0.5)
    try:
        yield daemon, peers["autopilot"], peers["ground"], recorder, task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def test_parameters_change_the_daemon_and_survive_a_restart_that_the_ground_asks_for(tmp_path: Path) -> None:
    async def main() -> None:
        async with running(config(tmp_path)) as (daemon, _, ground, _, task):
            for name, value in (("PERCH_STANDOFF", 0.75), ("LIM_BEND", 5.0), ("RATE_WRENCH", 5.0)):
                ground.send(mav.MAVLink_param_set_message(1, 192, name.encode(), value, mav.MAV_PARAM_TYPE_REAL32))
            await asyncio.sleep(0.2)
            present = daemon._parameters.config
            assert (present.perch.standoff_m, present.limits.bend_max_rad) == (0.75, 5.0)
            assert daemon._component.guidance.limits.bend_max_rad == 5.0
            ground.received.clear()
            await asyncio.sleep(2.0)
            assert len(ground.all("ARM_REACTION_WRENCH")) == pytest.approx(10, abs=1)
            daemon._state = dataclasses.replace(daemon._state, phase=Phase.PERCHED)
            ground.send(mav.MAVLink_param_set_message(1, 192, b"PERCH_STANDOFF", 0.5, mav.MAV_PARAM_TYPE_REAL32))
            await asyncio.sleep(0.0)
            await asyncio.sleep(0.001)
            assert daemon._parameters.config.perch.standoff_m == 0.75
            daemon._state = dataclasses.replace(daemon._state, phase=Phase.STOWED)
            await asyncio.sleep(0.1)
            ground.command(mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 0.0, 0.0, 1.0, 192.0)
            async with asyncio.timeout(2.0):
                await task
            assert ground.all("COMMAND_ACK")[-1].result == mav.MAV_RESULT_ACCEPTED
            assert daemon.power is Power.RESTART
        kept = json.loads((tmp_path / FILE).read_text())
        assert kept == {"limits.bend_max_rad": 5.0, "perch.standoff_m": 0.75, "rates.wrench_hz": 5.0}
        assert with_kept_changes(config(tmp_path)).perch.standoff_m == 0.75

    run_simulated(main())


def test_a_parameter_that_would_not_survive_a_restart_is_told(tmp_path: Path) -> None:
    (tmp_path / "full").write_text("no folder")

    async def main() -> None:
        async with running(config(tmp_path / "full")) as (daemon, _, ground, _, _task):
            for value in (5.0, 5.1):
                ground.send(mav.MAVLink_param_set_message(1, 192, b"LIM_BEND", value, mav.MAV_PARAM_TYPE_REAL32))
                await asyncio.sleep(0.05)
                time.sleep(0.1)  # noqa: ASYNC251 - the thread that writes knows no simulated time
                await asyncio.sleep(0.05)
            assert daemon._parameters.config.limits.bend_max_rad == 5.1
            told = [m.text for m in ground.all("STATUSTEXT") if "is not kept" in m.text]
            assert told == ["parameters.json is not kept: File exists"], "once"

    run_simulated(main())


def test_targets_setpoints_and_the_ground_stations_age_become_facts(tmp_path: Path) -> None:
    async def main() -> None:
        async with running(config(tmp_path)) as (_, autopilot, ground, recorder, _task):
            first = recorder.records[-1].facts
            assert (first.arm_setpoint, first.grasp_target, first.ground_age_s) == (None, None, math.inf)
            autopilot.heartbeat(mav.MAV_AUTOPILOT_PX4, 6 << 16)
            target = mav.MAVLink_arm_target_message(
                1, 192, 0, 1, 1, [3.0, 0.0, -2.0], [NAN] * 3, [1.0, 0.0, 0.0, 0.0], 0.03, [NAN] * 6, NAN
            )
            setpoint = mav.MAVLink_arm_setpoint_message(1, 192, 0, 1, NAN, NAN, [0.1, 0.0, 0.2], 0.3)
            ground.send(GCS, target)
            autopilot.send(tunnel(MavlinkCodec(1, 1).encode(setpoint), 1, 192))  # by the autopilot's link
            await asyncio.sleep(0.1)
            facts = recorder.records[-1].facts
            assert facts.grasp_target is not None
            assert facts.grasp_target_age_s == pytest.approx(0.1, abs=0.02)
            assert facts.arm_setpoint is not None
            assert facts.arm_setpoint.kind is SetpointKind.TIP
            assert facts.arm_setpoint.age_s == pytest.approx(0.1, abs=0.02)
            assert facts.ground_age_s == pytest.approx(0.1, abs=0.02)
            await asyncio.sleep(0.4)
            assert recorder.records[-1].facts.arm_setpoint is None
            assert recorder.records[-1].facts.grasp_target is not None

    run_simulated(main())


def test_a_key_that_cannot_be_used_is_a_configuration_error(tmp_path: Path) -> None:
    async def main() -> None:
        base = config(tmp_path)
        links = {**base.links, "ground": LinkConfig("udpout:127.0.0.1:1", signing_key=str(tmp_path / "missing"))}
        with pytest.raises(ConfigError, match="signing_key"):
            async with running(dataclasses.replace(base, links=links)):
                pass

    run_simulated(main())


def test_the_feedforward_is_switched_over_mavlink(tmp_path: Path) -> None:
    async def main() -> None:
        async with running(config(tmp_path)) as (daemon, _, ground, _recorder, _task):
            ground.send(GCS)
            for value, result, on in (
                (0.0, mav.MAV_RESULT_ACCEPTED, False),
                (2.0, mav.MAV_RESULT_DENIED, False),
                (1.0, mav.MAV_RESULT_ACCEPTED, True),
            ):
                ground.command(mav.MAV_CMD_ARM_FEEDFORWARD, value)
                await asyncio.sleep(0.3)
                assert ground.all("COMMAND_ACK")[-1].result == result
                assert daemon._state.feedforward is on

    run_simulated(main())


def test_servos_that_tripped_and_fell_silent_cost_the_cycle_nothing(tmp_path: Path) -> None:
    async def main() -> None:
        async with running(config(tmp_path)) as (daemon, _, ground, _recorder, _task):
            ground.send(GCS)
            for record in daemon._bus._records:
                record.tripped = True
            cycles = daemon.cycles
            await asyncio.sleep(3.0)
            assert daemon.cycles == pytest.approx(cycles + 300, abs=2)
            assert (daemon.missed, daemon.failures) == (0, 0)
            assert "silent too long" not in "".join(text.text for text in ground.all("STATUSTEXT"))

    run_simulated(main())
