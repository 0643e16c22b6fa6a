"""What the stiffness of an anchored arm asks of the vehicle: the lean with which it moves, and stays where it moved."""

import numpy as np

from arm_companion.arm.model import ArmSolution
from arm_companion.arm.reaction import GRAVITY
from arm_companion.errors import ModelError
from arm_companion.geometry import so3
from arm_companion.mission.facts import Vec3
from arm_companion.mission.motion import ZERO
from arm_companion.mission.situation import Situation


def holding_lean(s: Situation, solution: ArmSolution | None, move: Vec3) -> Vec3:
    """Acceleration that holds the vehicle displaced against the anchored arm, m/s^2, world axes; zero if not known.

    A multirotor leans to accelerate, and leaning swings the arm's base, so both act: with the arm's stiffness S at its
    base, the wanted move x of the centre of mass, base offset r and the tilt `phi = (-z) x a / g` that the acceleration
    a takes,

        m a + S_f (x + phi x r, phi) = 0.

    Args:
        s: now.
        solution: the anchored arm.
        move: from where the grip was taken, m, world axes.
    """
    if solution is None:
        return ZERO
    try:
        S = solution.base_stiffness[:3]
    except ModelError:
        return ZERO
    R_wb = so3.from_quaternion(s.facts.vehicle.attitude_wb)
    R_wa = R_wb @ s.mount.rotation
    S_move, S_turn = (R_wa @ S[:, half] @ R_wa.T for half in (slice(0, 3), slice(3, 6)))
    tilt = so3.hat((0.0, 0.0, -1.0)) / GRAVITY
    swing = -so3.hat(R_wb @ s.mount.position) @ tilt
    A = s.config.vehicle.mass_kg * np.eye(3) + S_move @ swing + S_turn @ tilt
    north, east, _ = -np.linalg.solve(A, S_move @ np.asarray(move))
    # up and down the autopilot's own loop is stiff and integrates, and a wrap pushed hard there slides
    return float(north), float(east), 0.0
