"""What the arm does to an airframe that hangs by it: the weight, less what the motors carry."""

import math

from arm_companion.arm.reaction import GRAVITY
from arm_companion.mission.facts import WrenchReport, WrenchSource
from arm_companion.mission.motion import ZERO, unrotate
from arm_companion.mission.sharing import motor_share
from arm_companion.mission.situation import Situation
from arm_companion.values import replace

_THRUST_SPREAD = 0.1  # one sigma of thrust against throttle, relative
_THROTTLE_SIGMA = 0.03  # of the hover's thrust: a throttle is told in whole per cent
_SIDE_SIGMA = 0.5  # N, wind and swinging
# a hanging autopilot goes on levelling a vehicle that cannot turn, until all thrust that is left is on one side:
# which side nobody knows, so of the torque that the arm balances only the size is told
_ROTOR_ARM_M = 0.15
_MOMENT_SIGMA = 0.1  # N m


def hung_wrench(s: Situation, report: WrenchReport, arm_mass: float) -> WrenchReport:
    """The wrench on a hanging airframe, body axes, from its balance; `report` as it is while the throttle is unknown.

    A vehicle at rest has no resultant: the arm pulls up what gravity pulls down and the motors do not carry,

        f = -(m - m_arm) g + share m |g| z_b,

    and twists it with what the motors do not balance: nothing on average, and as much as idling motors can.

    Args:
        s: the cycle.
        report: of the arm alone, whose residual of the mechanics is kept.
        arm_mass: kg, of the arm, which is a part of the vehicle's.
    """
    share = motor_share(s)
    if share is None or not s.vehicle_fresh:
        return report
    mass = s.config.vehicle.mass_kg
    x, y, z = unrotate(s.facts.vehicle.attitude_wb, (0.0, 0.0, -(mass - arm_mass) * GRAVITY))
    lifted, curve_sigma = _lifted(s, share)
    thrust = lifted * mass * GRAVITY
    down_sigma = math.hypot(_THRUST_SPREAD * thrust, math.hypot(_THROTTLE_SIGMA, curve_sigma) * mass * GRAVITY)
    torque_sigma = math.hypot(_ROTOR_ARM_M * thrust, _MOMENT_SIGMA)
    return replace(
        report,
        force_b=(x, y, z + thrust),
        torque_b=ZERO,
        force_sigma=(_SIDE_SIGMA, _SIDE_SIGMA, down_sigma),
        torque_sigma=(torque_sigma, torque_sigma, _MOMENT_SIGMA),
        source=WrenchSource.ANCHORED,
        valid=True,
    )


def _lifted(s: Situation, share: float) -> tuple[float, float]:
    """Thrust at a share of the hover's throttle, of the hover's thrust, and one sigma from the curve's steepness.

    A parabola through nothing at no throttle and the hover, with the slope there that free flight has taught: far
    below the hover, the slope alone would have the rotors suck. Where the autopilot makes thrust proportional itself,
    as ArduPilot does, a slope near 1 is what it teaches.
    """
    curve = s.state.load.curve
    if curve is None:
        return share, 0.0
    return share * (1.0 - (curve.gain - 1.0) * (1.0 - share)), curve.gain_sigma * abs(share * (1.0 - share))
