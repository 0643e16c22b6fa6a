"""Doctor's ears on the stand-ins of autopilot and servos, in simulated time."""

import asyncio
import dataclasses
import json
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from arm_companion.clock import SIMULATED_EPOCH_S, Clock, precise_loop, run_simulated
from arm_companion.config import Config, load
from arm_companion.config.schema import LinkConfig
from arm_companion.doctor.arm_checks import servos as check_servos
from arm_companion.doctor.check import Level, examine
from arm_companion.doctor.listening import listen_to_servos, listen_to_vehicle
from arm_companion.doctor.subject import ServosSeen, Subject, VehicleSeen
from arm_companion.doctor.vehicle_checks import CHECKS
from arm_companion.errors import LinkError
from arm_companion.sim.autopilot import AutopilotStandIn
from arm_companion.sim.runner import _in_real_time
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.sim.world import World
from arm_companion.transport.base import Receiver, Transport
from arm_companion.transport.memory import MemoryPipe
from tests.sim.flight_rig import config as sim_config
from tests.sim.flight_rig import stand
from tests.sim.rigid_body import RigidBody
from tests.unit.test_doctor import free_port, machine


def config(flavour: str = "px4") -> Config:
    base = Config()
    return dataclasses.replace(
        base,
        links={"autopilot": LinkConfig("udpin:127.0.0.1:1", "autopilot")},
        vehicle=dataclasses.replace(base.vehicle, autopilot=flavour),
    )


def heard(
    configured: Config, flavour: str, prepare: Callable[[AutopilotStandIn], None] = lambda _: None
) -> VehicleSeen:
    async def main() -> VehicleSeen:
        stand_in = AutopilotStandIn(sim_config(), flavour, ready_s=1.0)
        prepare(stand_in)
        companion, ground = MemoryPipe(), MemoryPipe()
        tasks = [
            asyncio.create_task(stand_in.run(companion.opener(0), ground.opener(0))),
            asyncio.create_task(stand(stand_in, RigidBody())),
        ]
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        try:
            return await listen_to_vehicle(configured, companion.opener(1), clock, 5.0)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    return run_simulated(main())


@pytest.mark.parametrize("flavour", ["px4", "ardupilot"])
def test_an_autopilot_is_heard_with_parameters_rates_and_clock(flavour: str, tmp_path: Path) -> None:
    seen = heard(config(flavour), flavour)
    assert seen.system_id == 1
    assert seen.fits
    assert seen.parameters
    assert all(got > 0.5 * asked for asked, got in seen.rates_hz.values()), seen.rates_hz
    assert seen.clock_error_s < 0.02
    findings = examine(CHECKS, Subject(machine(tmp_path), config(flavour), vehicle=seen))
    levels = {finding.check: finding.level for finding in findings}
    assert levels["link"] is levels["autopilot clock"] is Level.OK, findings


def test_another_flight_stack_is_told() -> None:
    assert not heard(config("px4"), "ardupilot").fits


def test_a_link_that_cannot_be_opened_is_the_finding() -> None:
    async def refuse(_: Receiver) -> Transport:
        raise LinkError("cannot open /dev/ttyX: no such device")

    async def main() -> VehicleSeen:
        clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
        return await listen_to_vehicle(config(), refuse, clock, 2.0)

    assert run_simulated(main()).error == "cannot open /dev/ttyX: no such device"


def servos_seen(known: Config, prepare: Callable[[ServoEmulator], None] = lambda _: None) -> ServosSeen:
    async def main() -> ServosSeen:
        emulator = ServoEmulator(known.bus_servos, seed=3)
        prepare(emulator)
        pipe, bus = MemoryPipe(latency_s=0.0001), EmulatedBus(emulator, known.bus_servos)
        tasks = [asyncio.create_task(bus.serve_memory(pipe.opener(0))), asyncio.create_task(keep_time(emulator))]
        await bus.wait_ready()
        try:
            return await listen_to_servos(known, pipe.opener(1))
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    return run_simulated(main())


def test_servos_are_heard() -> None:
    seen = servos_seen(Config())
    assert [servo.id for servo in seen.servos if not servo.silent] == [1, 2, 3, 4]
    assert all(servo.voltage > 9.0 for servo in seen.servos)
    assert seen.answers > 100
    assert 0 not in seen.firmware


def test_a_grippers_servo_is_one_of_them(tmp_path: Path) -> None:
    known = load("sim_gripper.toml")
    assert [servo.id for servo in servos_seen(known).servos if not servo.silent] == [1, 2, 3, 4, 5]

    def silence(emulator: ServoEmulator) -> None:
        emulator[5].silenced = True

    found = list(check_servos(Subject(machine(tmp_path), known, servos=servos_seen(known, silence))))
    assert found[0].found == "servo 5 is silent"


def test_a_bus_that_cannot_be_opened_is_the_finding() -> None:
    async def refuse(_: Receiver) -> Transport:
        raise LinkError("another program holds its lock")

    assert "another program" in run_simulated(listen_to_servos(Config(), refuse)).error


@pytest.mark.realtime
def test_doctor_against_the_simulated_world_in_real_time(tmp_path: Path) -> None:
    """The command as a person runs it: sockets, a pty, a process of its own, and no daemon."""
    ports = [free_port() for _ in range(4)]
    settings = [
        f"links.autopilot.url=udpin:127.0.0.1:{ports[0]}",
        f"sim.autopilot_url=udpout:127.0.0.1:{ports[0]}",
        f"sim.operator_autopilot_url=udpin:127.0.0.1:{ports[1]}",
        f"servos.port={tmp_path / 'bus'}",
    ]
    configured = load("sim.toml", settings)
    words = [sys.executable, "-m", "arm_companion", "doctor", "--config", "sim.toml", "--json"]
    for setting in settings:
        words += ["--set", setting]

    async def main() -> dict[str, str]:
        async with _in_real_time(World(configured), configured):
            doctor = await asyncio.create_subprocess_exec(*words, stdout=asyncio.subprocess.PIPE)
            output, _ = await asyncio.wait_for(doctor.communicate(), 40.0)
            return {row["check"]: row["level"] for row in json.loads(output)["checks"]}

    levels = _run(main())
    assert levels["voltage"] == levels["autopilot parameters"] == "ok", levels
    # a desktop that is busy loses a frame now and then, which is a warning
    assert {levels["link"], levels["servos"]} <= {"ok", "warn"}, levels


def _run(main: Coroutine[Any, Any, dict[str, str]]) -> dict[str, str]:
    with asyncio.Runner(loop_factory=precise_loop) as runner:
        return runner.run(main)
