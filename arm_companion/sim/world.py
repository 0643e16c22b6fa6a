"""The world as one task: plant, autopilot stand-in and servos take turns on the event loop's time.

They exchange the values of `ports` and nothing else. In real time the loop's clock drives the physics; in
simulated time the loop jumps from step to step, so the same program runs as fast as the processor allows.
"""

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arm_companion.clock import ticks
from arm_companion.config.schema import Config
from arm_companion.sim.autopilot import AutopilotStandIn
from arm_companion.sim.plant import Plant, Pose
from arm_companion.sim.ports import PlantTruth, RigidState, Vec3
from arm_companion.sim.servo_emulator import ServoEmulator

_CONTROL_PERIOD_S = 0.004  # 250 Hz, as PX4 and ArduPilot run their attitude loops and more often than servos answer
_SAMPLE_EVERY = 10  # control periods
_MOST_BEHIND_S = 0.1
_PERIODS_IN_ONE_GO = 2
_TICKS_PER_RAD = 4096 / (2.0 * math.pi)


@dataclass(frozen=True, slots=True)
class Sample:
    """The truth at one instant, with the loop time at which it held."""

    t: float
    state: RigidState
    truth: PlantTruth
    asked_w: Vec3 | None = None  # position that the autopilot flies to; None: none, or not in all axes


class World:
    """Plant, autopilot stand-in and servo emulator, stepped together."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.plant = Plant(config)
        self.autopilot = AutopilotStandIn(config, config.vehicle.autopilot)
        self.servos = ServoEmulator(config.servos, config.sim.seed)
        self.samples: list[Sample] = []
        self.events: list[tuple[float, Callable[[World], None]]] = []
        self.poses: list[Pose] = []
        self.pose_every_s: float | None = None
        """How often a pose is kept, for a film; None: never."""
        self.lost_s = 0.0  # real time that the physics could not keep up with

    def at(self, t: float, event: "Callable[[World], None]") -> None:
        """Let `event` happen to the world at plant time `t`: a gust, a moved bar, a dead servo."""
        self.events.append((t, event))
        self.events.sort(key=lambda pair: pair[0])

    async def run(self) -> None:
        """Step until cancelled, in pace with the loop's clock."""
        loop = asyncio.get_running_loop()
        start = loop.time()
        periods = 0
        async for tick in ticks(_CONTROL_PERIOD_S):
            lag = tick.now - start - self.lost_s - periods * _CONTROL_PERIOD_S
            if lag > _MOST_BEHIND_S:  # the machine stalled: this time is lost
                self.lost_s += lag - _MOST_BEHIND_S
                lag = _MOST_BEHIND_S
            # who is late catches up in small steps, and answers the servo bus in between
            for _ in range(min(math.floor(lag / _CONTROL_PERIOD_S + 0.5) + 1, _PERIODS_IN_ONE_GO)):
                self._advance()
                periods += 1
                if periods % _SAMPLE_EVERY == 0:
                    sample = Sample(tick.now, self.plant.state(), self.plant.truth(), self.autopilot.asked_w)
                    self.samples.append(sample)
            for servo in self.servos.servos:
                servo.lag_s = loop.time() - start - periods * _CONTROL_PERIOD_S

    def _advance(self) -> None:
        """One control period."""
        if self.pose_every_s is not None and self.plant.time >= len(self.poses) * self.pose_every_s:
            self.poses.append(self.plant.pose())
        while self.events and self.events[0][0] <= self.plant.time:
            self.events.pop(0)[1](self)
        config = self._config
        rotors = self.autopilot.control(self.plant.state(), _CONTROL_PERIOD_S)
        radius = config.arm.pulley_radius_m
        tensions = self.plant.tensions()
        if coupling := config.servos.coupling:
            tensions = tuple((np.array(coupling).T @ tensions).tolist())
        self.servos.advance(_CONTROL_PERIOD_S, [radius * tension for tension in tensions])
        pulls = [
            direction * (position - zero) / _TICKS_PER_RAD * radius
            for position, zero, direction in zip(
                self.servos.positions(), config.servos.zero_ticks, config.servos.directions, strict=True
            )
        ]
        if coupling:
            pulls = (np.array(coupling) @ pulls).tolist()
        for _ in range(round(_CONTROL_PERIOD_S / config.sim.step_s)):
            self.plant.step(rotors, pulls)
