"""How hard an anchored vehicle presses on the bar: bounded in a vertical move, and eased before the arm lets go.

No elastic model knows how hard the bar's friction holds a wrap from below, and no message tells what an autopilot's own
integrator pushes. The rotors tell both together, as a vehicle that seems lighter than it is.
"""

import math

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.facts import Vec3
from arm_companion.mission.motion import add
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import Phase

EASED_S = 6.0
"""An autopilot that has not let up by then will not."""

_TOLD_SHARE = 0.5  # of `perch.slide_force_n`, with which the rotors must tell the force of a vertical move
_TOLD_N = 0.5  # and what is to be eased
_TRIM_N_PER_M_S = 100.0  # growth of the vertical push, N/s for each metre that is still to go
_EASE_PER_S = 2.0
_LIGHT_N = 0.25  # what makes a vehicle sink by millimetres only, as the arm lets go
_LIFT_M_PER_N = 0.04  # ArduPilot's integrator lets up with 20 N/s for each metre, PX4's with 4
_MOST_LIFT_M = 0.03


def pressed(s: Situation, sigma: float) -> float | None:
    """Force, N, downwards, of vehicle and autopilot on what the arm holds.

    Args:
        s: this cycle.
        sigma: one sigma, N, with which the rotors must tell it at least.

    Returns:
        None: they do not tell it so well.
    """
    load = s.state.load
    if not (s.vehicle_fresh and math.isfinite(load.now)):
        return None
    return -load.now * GRAVITY if load.sigma_now(s.config.vehicle.mass_kg) * GRAVITY < sigma else None


def trim(s: Situation) -> float:
    """Downward acceleration that makes a vertical move against a wrap which slides on its bar, m/s^2.

    How hard the bar's friction holds on, no elastic model knows. So the force is found: it grows with the error
    until the vehicle moves, never beyond `perch.slide_force_n`, and only while a vertical move is asked for. The
    autopilot pushes too, the longer the harder: what the rotors say of both together stays within that force, else
    the ring around the bar tips over. docs/adr/0017 has the margin to instability.
    """
    down = s.state.offset[2]
    if not down or not s.vehicle_fresh:
        return 0.0
    error = s.rest[2] + down - s.state.position[2]
    most = s.config.perch.slide_force_n
    change, force = _TRIM_N_PER_M_S * error, pressed(s, _TOLD_SHARE * most)
    if force is not None:
        beyond = force - min(max(force, -most), most)
        change = -_EASE_PER_S * beyond if beyond else change
    mass = s.config.vehicle.mass_kg
    return min(max(s.state.lean[2] * mass + change * s.dt, -most), most) / mass


def eased(s: Situation) -> Vec3:
    """Where a vehicle that is about to let go is asked to be, world axes: at rest, and higher while it presses down.

    The arm carries that force until it opens, and the vehicle would sink by it onto the bar, as an integrator
    takes seconds to let up. A reference above the vehicle winds it back.
    """
    return add(s.rest, (0.0, 0.0, -min(_LIFT_M_PER_N * _too_much(s), _MOST_LIFT_M)))


def is_eased(s: Situation) -> bool:
    """Whether the vehicle does not sink, or not for long, when the arm lets go."""
    return not _too_much(s) or s.elapsed > EASED_S


def not_back_down(s: Situation, place: Vec3, before: Vec3) -> Vec3:
    """A place on the way up beside the bar, but no lower than easing left the reference `before`, world axes."""
    if not _leaves(s) or s.state.phase is not Phase.RELEASE:
        return place
    x, y, z = place
    return x, y, min(z, max(before[2], z - _MOST_LIFT_M))


def _leaves(s: Situation) -> bool:
    return s.state.perches_below and s.state.anchor is not None


def _too_much(s: Situation) -> float:
    """Force, N, by which the vehicle presses down on the bar that it is about to leave; 0: it does not."""
    force = pressed(s, _TOLD_N) if _leaves(s) and s.external else None
    return force if force is not None and force > _LIGHT_N else 0.0
