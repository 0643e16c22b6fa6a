"""Four rotors of a quadrotor in X: from what a real flight stack commands each motor to thrust and torque.

A rotor turns about as fast as it is commanded, and its thrust grows with the square of its speed; thrust follows a
command with the motor's lag. At full throttle the four lift twice the vehicle's weight, so that it hovers at 0.71
of the throttle's range, or at half the thrust, which is what PX4 and ArduPilot expect when told of the square.
"""

import math
from collections.abc import Sequence

from arm_companion.sim.ports import RotorCommand

THRUST_TO_WEIGHT = 2.0
LAG_S = 0.025
ARM_M = 0.18
"""Distance of each rotor from the centre along x and along y; the plant's airframe has its rotors there."""
TORQUE_PER_THRUST_M = 0.016
"""Drag torque over thrust of a ten-inch propeller."""
_GRAVITY = 9.81

# Place along x and y in ARM_M, and the turn that the drag gives the body: + is clockwise seen from above, which a
# propeller gives that turns the other way. Front right, rear left, front left, rear right: PX4's and ArduPilot's order.
LAYOUT = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))


class Rotors:
    """The rotors and their lag.

    Args:
        mass: of the whole vehicle, kg.
    """

    def __init__(self, mass: float) -> None:
        self._most = THRUST_TO_WEIGHT * mass * _GRAVITY / len(LAYOUT)
        self._thrust = [0.0] * len(LAYOUT)

    def turn(self, throttles: Sequence[float], dt: float) -> RotorCommand:
        """What the rotors exert after `dt` seconds of these commands.

        Args:
            throttles: one for each rotor, share of the throttle's range; what is outside 0 to 1, or no number, is
                taken as the nearest, or as 0.
            dt: s.

        Raises:
            ValueError: not one throttle for each rotor.
        """
        share = 1.0 - math.exp(-dt / LAG_S)
        force, roll, pitch, yaw = 0.0, 0.0, 0.0, 0.0
        for i, (throttle, (x, y, drag)) in enumerate(zip(throttles, LAYOUT, strict=True)):
            inside = min(max(throttle, 0.0), 1.0) if math.isfinite(throttle) else 0.0
            self._thrust[i] += share * (self._most * inside**2 - self._thrust[i])
            thrust = self._thrust[i]
            force += thrust
            roll -= y * ARM_M * thrust
            pitch += x * ARM_M * thrust
            yaw += drag * TORQUE_PER_THRUST_M * thrust
        return RotorCommand(force, (roll, pitch, yaw))
