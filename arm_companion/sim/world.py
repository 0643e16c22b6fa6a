"""The world as one task: plant, autopilot stand-in and servos take turns on the event loop's time.

They exchange the values of `ports` and nothing else. In real time the loop's clock drives the physics; in
simulated time the loop jumps from step to step, so the same program runs as fast as the processor allows.
"""

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from arm_companion.clock import ticks
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError
from arm_companion.sim.autopilot import AutopilotStandIn
from arm_companion.sim.jaws import OutputDrive, ServoDrive
from arm_companion.sim.plant import Plant, Pose
from arm_companion.sim.ports import PlantTruth, RigidState, RotorCommand
from arm_companion.sim.servo_emulator import ServoEmulator
from arm_companion.sim.wind import Wind
from arm_companion.transport.base import Opener

_SAMPLE_PERIOD_S = 0.04
_MOST_BEHIND_S = 0.1
_IN_ONE_GO_S = 0.008
_TICKS_PER_RAD = 4096 / (2.0 * math.pi)


@dataclass(frozen=True, slots=True)
class Sample:
    """The truth at one instant, with the loop time at which it held; its wrench is the mean since the sample before.

    What the airframe touches is all that it touched since then.
    """

    t: float
    state: RigidState
    truth: PlantTruth


class FlightStack(Protocol):
    """Who flies the vehicle: the stand-in, or a real flight stack behind a bridge.

    Attributes:
        period_s: s between two looks at the vehicle.
    """

    period_s: float

    def due(self) -> bool:
        """Whether the world may go on; False while a flight stack in lock-step has not had its turn."""

    def control(self, state: RigidState, dt: float) -> RotorCommand:
        """What the rotors exert until the next call, `dt` seconds later."""

    async def run(self, companion: Opener, ground: Opener) -> None:
        """Serve the ports to the companion and to the ground until cancelled."""


class World:
    """Plant, flight stack and servo emulator, stepped together.

    Args:
        config: of the world.
        flown_by: a flight stack in place of the stand-in.
    """

    def __init__(self, config: Config, flown_by: FlightStack | None = None) -> None:
        self._config = config
        self.plant = Plant(config)
        self.wind = Wind(config.sim.wind_m_per_s, config.sim.gust_m_per_s, config.sim.seed)
        self.flown_by: FlightStack = flown_by or AutopilotStandIn(config, config.vehicle.autopilot)
        self._period_s = self.flown_by.period_s
        self.servos = ServoEmulator(config.bus_servos, config.sim.seed)
        gripper = config.gripper_servo
        self._horn = None if gripper is None else ServoDrive(gripper, config.sim.gripper.opening_m)
        self._output = OutputDrive()
        if config.gripper_by == "autopilot" and flown_by is not None:
            raise ConfigError('gripper.by = "autopilot": only the stand-in has a gripper on its outputs')
        self.samples: list[Sample] = []
        self.events: list[tuple[float, Callable[[World], None]]] = []
        self.poses: list[Pose] = []
        self.pose_every_s: float | None = None
        """How often a pose is kept, for a film; None: never."""
        self.lost_s = 0.0  # real time that the physics could not keep up with

    @property
    def autopilot(self) -> AutopilotStandIn:
        """The stand-in.

        Raises:
            TypeError: a real flight stack flies.
        """
        if not isinstance(self.flown_by, AutopilotStandIn):
            raise TypeError("no stand-in flies this world")
        return self.flown_by

    def at(self, t: float, event: "Callable[[World], None]") -> None:
        """Let `event` happen to the world at plant time `t`: a gust, a moved bar, a dead servo."""
        self.events.append((t, event))
        self.events.sort(key=lambda pair: pair[0])

    async def run(self) -> None:
        """Step until cancelled, in pace with the loop's clock."""
        loop = asyncio.get_running_loop()
        start = loop.time()
        period, periods = self._period_s, 0
        most, sampled = round(_IN_ONE_GO_S / period), round(_SAMPLE_PERIOD_S / period)
        for servo in self.servos.servos:
            # asked for afresh: after a stall servos answer before they have caught up
            servo.lag = lambda: loop.time() - start - periods * period
        async for tick in ticks(period):
            lag = tick.now - start - self.lost_s - periods * period
            if lag > _MOST_BEHIND_S:  # the machine stalled: this time is lost
                self.lost_s += lag - _MOST_BEHIND_S
                lag = _MOST_BEHIND_S
            # who is late catches up in small steps, and answers the servo bus in between
            for _ in range(min(math.floor(lag / period + 0.5) + 1, most)):
                if not self.flown_by.due():
                    break
                self._advance()
                periods += 1
                if periods % sampled == 0:
                    force, torque = self.plant.mean_wrench()
                    touched = self.plant.touched()
                    truth = replace(
                        self.plant.truth(),
                        force_b=force,
                        torque_b=torque,
                        body_contact=touched.body,
                        mount_only=touched.mount_only,
                        rotor_contact=touched.rotor,
                    )
                    self.samples.append(Sample(tick.now, self.plant.state(), truth))

    def _advance(self) -> None:
        """One control period."""
        if self.pose_every_s is not None and self.plant.time >= len(self.poses) * self.pose_every_s:
            self.poses.append(self.plant.pose())
        while self.events and self.events[0][0] <= self.plant.time:
            self.events.pop(0)[1](self)
        config, period = self._config, self._period_s
        self.plant.blow(self.wind.at(self.plant.time))
        rotors = self.flown_by.control(self.plant.state(), period)
        radius = config.arm.pulley_radius_m
        tensions = self.plant.tensions()
        if coupling := config.servos.coupling:
            tensions = tuple((np.array(coupling).T @ tensions).tolist())
        self.servos.advance(period, [radius * tension for tension in tensions] + self._jaws_torque())
        pulls = [
            direction * (position - zero) / _TICKS_PER_RAD * radius
            for position, zero, direction in zip(
                self.servos.positions()[: len(tensions)],
                config.servos.zero_ticks,
                config.servos.directions,
                strict=True,
            )
        ]
        self._drive_jaws()
        if coupling:
            pulls = (np.array(coupling) @ pulls).tolist()
        for _ in range(round(period / config.sim.step_s)):
            self.plant.step(rotors, pulls)

    def _jaws_torque(self) -> list[float]:
        """What the jaws put on the horn of their servo, N m; nothing when they have none."""
        jaws = self.plant.jaws
        return [] if jaws is None or self._horn is None else [self._horn.torque(jaws.force)]

    def _drive_jaws(self) -> None:
        jaws = self.plant.jaws
        if jaws is None:
            return
        if self._horn is not None:
            jaws.drive(self._horn.closed(self.servos.positions()[-1]))
        else:
            closing = self.autopilot.gripper.closing
            jaws.drive(self._output.advance(closing=closing, force=jaws.force, dt=self._period_s))
