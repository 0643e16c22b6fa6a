"""A rigid airframe in NumPy with a flat ground and an optional tether: plant enough to fly a controller."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from arm_companion.sim.ports import RigidState, RotorCommand

Vector = NDArray[np.float64]
GRAVITY_W = np.array([0.0, 0.0, 9.80665])


def rotation(q: Vector) -> Vector:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def no_force(_position: Vector, _velocity: Vector) -> Vector:
    return np.zeros(3)


@dataclass
class RigidBody:
    """`force` gives an outer force (N, world) at the centre of mass from position and velocity."""

    mass: float = 1.8
    inertia: Vector = field(default_factory=lambda: np.array([0.018, 0.02, 0.03]))
    force: Callable[[Vector, Vector], Vector] = no_force
    moment_b: Vector = field(default_factory=lambda: np.zeros(3))
    drag: float = 0.25  # N per m/s
    position: Vector = field(default_factory=lambda: np.zeros(3))
    velocity: Vector = field(default_factory=lambda: np.zeros(3))
    attitude: Vector = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    rate: Vector = field(default_factory=lambda: np.zeros(3))
    specific_force: Vector = field(default_factory=lambda: -GRAVITY_W)

    def step(self, rotors: RotorCommand, dt: float) -> None:
        turn = rotation(self.attitude)
        force = turn @ np.array([0.0, 0.0, -rotors.thrust_n]) - self.drag * self.velocity
        force += self.force(self.position, self.velocity)
        torque = np.array(rotors.torque_b) + self.moment_b - 0.01 * self.rate
        if self.position[2] > 0.0:  # skids in the ground: a stiff, damped spring that also rights the frame
            force += np.array([0.0, 0.0, min(-4000.0 * self.position[2] - 120.0 * self.velocity[2], 0.0)])
            force[:2] -= 20.0 * self.velocity[:2]
            torque -= 2.0 * np.array([2 * self.attitude[1], 2 * self.attitude[2], 0.0]) + 0.3 * self.rate
        acceleration = force / self.mass + GRAVITY_W
        self.specific_force = turn.T @ (acceleration - GRAVITY_W)
        self.velocity = self.velocity + acceleration * dt
        self.position = self.position + self.velocity * dt
        a, b, c = self.rate
        momentum = self.inertia * self.rate
        gyroscopic = (
            b * momentum[2] - c * momentum[1],
            c * momentum[0] - a * momentum[2],
            a * momentum[1] - b * momentum[0],
        )
        self.rate = self.rate + (torque - gyroscopic) / self.inertia * dt
        w, x, y, z = self.attitude
        p, q, r = 0.5 * dt * self.rate
        turned = self.attitude + np.array(
            [-x * p - y * q - z * r, w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p]
        )
        self.attitude = turned / math.sqrt(float(turned @ turned))

    def state(self) -> RigidState:
        def three(v: Vector) -> tuple[float, float, float]:
            return float(v[0]), float(v[1]), float(v[2])

        w, x, y, z = (float(part) for part in self.attitude)
        position, velocity, rate, force = map(three, (self.position, self.velocity, self.rate, self.specific_force))
        return RigidState(position, velocity, (w, x, y, z), rate, force)

    @property
    def tilt(self) -> float:
        return math.acos(min(float(rotation(self.attitude)[2, 2]), 1.0))
