"""The pull test of a closed wrap: the vehicle is asked away from the bar, and a good grip gives what its arm does.

How far a vehicle gets depends on how hard its autopilot pulls: by the same good grip ArduPilot makes twice PX4's way.
So what the arm's stiffness gives to that pull is no fault of the grip (ADR 0040).
"""

from arm_companion.mission.estimate import lean_of
from arm_companion.mission.facts import Vec3
from arm_companion.mission.held_arm import holding_lean
from arm_companion.mission.motion import dot, scale, sub
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import PerchKind

_PROBE_S = 3.0


def pull_test_share(s: Situation) -> float:
    """Share of the asked move that the pull test's vehicle made, away from the bar.

    Both places are smoothed: an estimator's noise of 4 mm is 8 % of the move, and the limit is 30 %.
    """
    return dot(sub(s.state.position, s.probe), _back(s)) / s.config.perch.verify_pull_m


def stretch_share(s: Situation) -> float:
    """Share of the asked move that the arm's stiffness gives to the pull that the vehicle's lean shows.

    The pull is counted from the moment of the grip, whose place counts, too; so wind drops out. No more is explained
    than may be given without: a gust in the vehicle's face looks like a pull, and a grip that holds nothing makes the
    whole move.
    """
    prediction, anchor, perch = s.state.prediction, s.state.anchor, s.config.perch
    if prediction is None or anchor is None:
        return 0.0
    now, before = lean_of(s.facts.vehicle.attitude_wb), lean_of(anchor.attitude_wb)
    whole = dot(holding_lean(s, prediction.anchored, scale(_back(s), perch.verify_pull_m)), _back(s))
    if now is None or before is None or whole <= 0.0:
        return 0.0
    pull = dot((now[0] - before[0], now[1] - before[1], 0.0), _back(s))
    return min(max(pull / whole, 0.0), perch.verify_give_share)


def pull_test_passed(s: Situation) -> str | None:
    """The grip gave less than the allowed share beyond its stretch."""
    return None if (given := _given(s)) is None or not given[0] else f"pull test passed: {given[1]}"


def pull_test_failed(s: Situation) -> str | None:
    """The pull test moved the vehicle as if nothing held it."""
    return None if (given := _given(s)) is None or given[0] else f"pull test failed: {given[1]}"


def tested_to_hang(s: Situation) -> str | None:
    """The grip is good, and the vehicle shall hang by it."""
    return pull_test_passed(s) if s.state.kind is PerchKind.HANG else None


def _given(s: Situation) -> tuple[bool, str] | None:
    """Whether the grip is good, and what it gave, in words; None: it is not to be judged."""
    if s.grasping or s.elapsed < _PROBE_S:
        return None
    share, stretch = pull_test_share(s), stretch_share(s)
    words = f"gave {share:.0%} of the asked move, the arm's stretch {stretch:.0%}"
    return share - stretch < s.config.perch.verify_give_share, words


def _back(s: Situation) -> Vec3:
    return scale(s.ahead, -1.0)
