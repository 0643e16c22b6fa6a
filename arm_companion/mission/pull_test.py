"""The pull test of a closed wrap: the vehicle is asked away from the bar, and a good grip gives little."""

from arm_companion.mission.motion import dot, scale, sub
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import PerchKind

_PROBE_S = 3.0


def pull_test_share(s: Situation) -> float:
    """Share of the asked move that the pull test's vehicle made, away from the bar.

    Both places are smoothed: an estimator's noise of 4 mm is 8 % of the move, and the limit is 30 %.
    """
    back = scale(s.ahead, -1.0)
    return dot(sub(s.state.position, s.probe), back) / s.config.perch.verify_pull_m


def pull_test_passed(s: Situation) -> str | None:
    """The grip gave less than the allowed share."""
    share = pull_test_share(s)
    if s.grasping or s.elapsed < _PROBE_S or share >= s.config.perch.verify_give_share:
        return None
    return f"pull test passed: gave {share:.0%} of the asked move"


def pull_test_failed(s: Situation) -> str | None:
    """The pull test moved the vehicle as if nothing held it."""
    share = pull_test_share(s)
    if s.grasping or s.elapsed < _PROBE_S or share < s.config.perch.verify_give_share:
        return None
    return f"pull test failed: gave {share:.0%} of the asked move"


def tested_to_hang(s: Situation) -> str | None:
    """The grip is good, and the vehicle shall hang by it."""
    return pull_test_passed(s) if s.state.kind is PerchKind.HANG else None
