"""Starts a whole flight: in real time with the daemon as its own process, or in simulated time in one."""

import asyncio
import contextlib
import dataclasses
import os
import signal
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arm_companion.app import Daemon, Openers
from arm_companion.arm import compiled
from arm_companion.arm.parameters import ArmParameters
from arm_companion.arm.rod_model import RodModel
from arm_companion.clock import SIMULATED_EPOCH_S, Clock
from arm_companion.config.schema import Config
from arm_companion.errors import ArmError
from arm_companion.record import open_recorder
from arm_companion.record.recorder import Both, MemoryRecorder, Record
from arm_companion.sim.flight import Flight
from arm_companion.sim.operator_link import OperatorLink
from arm_companion.sim.orphans import end_with_parent
from arm_companion.sim.plant import Pose
from arm_companion.sim.scenario import Operator, Say
from arm_companion.sim.servo_emulator import EmulatedBus
from arm_companion.sim.world import FlightStack, World
from arm_companion.supervisor import ServiceManager
from arm_companion.transport.base import Opener
from arm_companion.transport.memory import MemoryPipe
from arm_companion.transport.urls import open_url

_STOP_WITHIN_S = 5.0
_HOPELESS_S = 5.0
Prepare = Callable[[World], None]
Script = Callable[[Operator], Coroutine[Any, Any, str]]


@dataclass(repr=False)  # asyncio's runner makes the text of a task's result, which here is a whole flight
class Result:
    """What a flight leaves behind."""

    flight: Flight
    failure: str
    cycles: int = 0
    missed: int = 0
    lost_s: float = 0.0  # real time that the physics could not keep up with
    poses: list[Pose] = dataclasses.field(default_factory=list)
    records: list[Record] = dataclasses.field(default_factory=list)


class DaemonDied(ArmError):
    """The daemon's process ended while it was needed."""


async def fly_simulated(
    config: Config,
    say: Say,
    prepare: Prepare = lambda _: None,
    log: Path | None = None,
    *,
    world: Config | None = None,
    fly: Script = Operator.fly_perch,
    flown_by: FlightStack | None = None,
    latency_s: float = 0.0002,
) -> Result:
    """One flight on the running simulated loop: every part in this process, over in-memory pipes.

    Args:
        config: the daemon's.
        say: told what happens.
        prepare: changes the world before the flight.
        log: where the daemon's record goes.
        world: how the world is, where it differs from what the daemon believes.
        fly: the operator's script.
        flown_by: a flight stack in place of the stand-in.
        latency_s: of the line between autopilot and daemon, each way.
    """
    companion, ground, arm, servos = MemoryPipe(latency_s), MemoryPipe(), MemoryPipe(), MemoryPipe()
    plant = World(config if world is None else world, flown_by)
    prepare(plant)
    clock = Clock(asyncio.get_running_loop(), SIMULATED_EPOCH_S)
    memory = MemoryRecorder()
    recorder = memory if log is None else Both(memory, open_recorder(log, config, clock, patient=True))
    openers = Openers(
        {
            name: companion.opener(1) if link.role == "autopilot" else arm.opener(0)
            for name, link in config.links.items()
        },
        servos.opener(1),
    )
    daemon = Daemon(config, openers, clock, ServiceManager(""), recorder, model=_model(config))
    bus = EmulatedBus(plant.servos, config.bus_servos)
    flight = Flight(samples=plant.samples)
    link = OperatorLink([ground.opener(1), arm.opener(1)])
    stop = asyncio.Event()
    async with _running(
        plant.run,
        lambda: plant.flown_by.run(companion.opener(0), ground.opener(0)),
        lambda: bus.serve_memory(servos.opener(0)),
        lambda: daemon.run(stop),
        link.run,
    ):
        failure = await fly(Operator(link, config, flight, say))
        stop.set()
        await asyncio.sleep(0.5)
    flight.asked = [(r.t, r.commands.setpoint.position_w) for r in memory.records if r.commands.setpoint is not None]
    return Result(flight, failure, daemon.cycles, daemon.missed, poses=plant.poses, records=memory.records)


def _model(config: Config) -> RodModel:
    """The rod that the daemon flies with, compiled where that costs no compiling."""
    try:
        compiled.load(compiling=False)
    except compiled.NotCompiled:
        return RodModel(ArmParameters.of(config.arm))
    return RodModel(ArmParameters.of(config.arm), fast=True)


async def fly_real_time(
    config: Config,
    daemon_arguments: Sequence[str],
    log: Path,
    say: Say,
    prepare: Prepare = lambda _: None,
    *,
    fly: Script = Operator.fly_perch,
    flown_by: FlightStack | None = None,
) -> Result:
    """One flight in real time: UDP, a pty, and the daemon as in flight, in a process of its own.

    Args:
        config: the configuration that the daemon is given too.
        daemon_arguments: what follows `arm-companion` on its command line.
        log: where the daemon's standard error goes.
        say: told what happens.
        prepare: changes the world before the flight.
        fly: the operator's script.
        flown_by: a flight stack in place of the stand-in.
    """
    world = World(config, flown_by)
    prepare(world)
    flight = Flight(samples=world.samples)
    sim = config.sim
    link = OperatorLink([open_url(sim.operator_autopilot_url), open_url(sim.operator_arm_url)])
    async with _in_real_time(world, config), _running(link.run), _daemon_process(daemon_arguments, log) as daemon:
        operator = asyncio.create_task(fly(Operator(link, config, flight, say)))
        died = asyncio.create_task(daemon.wait())
        behind = asyncio.create_task(_falls_behind(world))
        done, _ = await asyncio.wait({operator, died, behind}, return_when=asyncio.FIRST_COMPLETED)
        if operator in done:
            failure = operator.result()
        else:
            operator.cancel()
            await asyncio.gather(operator, return_exceptions=True)
            if died in done:
                raise DaemonDied(f"the daemon ended with code {died.result()}; see {log}")
            failure = "this machine is too slow for real time"
            flight.end = asyncio.get_running_loop().time()
        died.cancel()
        behind.cancel()
    if world.lost_s > 0.0:
        say(f"this machine was too slow: the physics lost {world.lost_s:.2f} s")
    return Result(flight, failure, lost_s=world.lost_s, poses=world.poses)


async def _falls_behind(world: World) -> None:
    """Return once the physics have lost so much time that a flight in them is none."""
    while world.lost_s < _HOPELESS_S:  # noqa: ASYNC110 - the physics count, and wake nobody
        await asyncio.sleep(0.1)


async def serve(config: Config, daemon_arguments: Sequence[str], log: Path, say: Say, stop: asyncio.Event) -> None:
    """The world and the daemon without an operator, until `stop`: for a person with a ground station.

    Args:
        config: the configuration that the daemon is given too.
        daemon_arguments: what follows `arm-companion` on its command line.
        log: where the daemon's standard error goes.
        say: told when it is ready.
        stop: ends it.
    """
    sim = config.sim
    async with _in_real_time(World(config), config), _daemon_process(daemon_arguments, log) as daemon:
        say(f"autopilot talks to {sim.operator_autopilot_url}, arm to {sim.operator_arm_url}; Ctrl-C ends")
        stopped = asyncio.create_task(stop.wait())
        died = asyncio.create_task(daemon.wait())
        await asyncio.wait({stopped, died}, return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        if died.done():
            raise DaemonDied(f"the daemon ended with code {died.result()}; see {log}")
        died.cancel()


@contextlib.asynccontextmanager
async def _in_real_time(world: World, config: Config) -> AsyncIterator[None]:
    """The world on its sockets and its pty, ready to be talked to."""
    sim = config.sim
    bus = EmulatedBus(world.servos, config.bus_servos)
    ground: Opener = open_url(sim.operator_autopilot_url.replace("udpin:", "udpout:"))
    async with _running(
        world.run,
        lambda: world.flown_by.run(open_url(sim.autopilot_url), ground),
        lambda: bus.serve_pty(config.servos.port),
    ):
        await bus.wait_ready()
        yield


@contextlib.asynccontextmanager
async def _running(*tasks: Callable[[], Awaitable[None]]) -> AsyncIterator[None]:
    """Run tasks in the background; one that fails ends the block, and leaving it cancels them all."""

    async def run(task: Callable[[], Awaitable[None]]) -> None:
        await task()

    failure: BaseException | None = None
    try:
        async with asyncio.TaskGroup() as group:
            running = [group.create_task(run(task)) for task in tasks]
            try:
                yield
            except ArmError as error:  # the block's own failure, which the group would wrap
                failure = error
            finally:
                for task in running:
                    task.cancel()
    except* ArmError as several:  # of a task, such as a flight stack that has ended: one is enough to tell
        failure = several
        while isinstance(failure, BaseExceptionGroup):
            failure = failure.exceptions[0]
    if failure is not None:
        raise failure


@contextlib.asynccontextmanager
async def _daemon_process(arguments: Sequence[str], log: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    """The daemon as a process; it is asked to stop with SIGTERM, and killed only if it does not."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as stream:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "arm_companion",
            *arguments,
            stdout=stream,
            stderr=stream,
            env=dict(os.environ),
            preexec_fn=end_with_parent,
        )
        try:
            yield process
        finally:
            if process.returncode is None:
                process.send_signal(signal.SIGTERM)
                try:
                    async with asyncio.timeout(_STOP_WITHIN_S):
                        await process.wait()
                except TimeoutError:
                    process.kill()
                    await process.wait()
