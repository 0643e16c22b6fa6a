"""ARM_TARGET: from what a ground station or a vision process claims to a bar that the mission may use."""

import math
from typing import Final

from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import Bar
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

_FARTHEST_M: Final = 10_000.0
_RADII_M: Final = (0.002, 0.5)
_SHORTEST_AXIS: Final = 1e-3


def read_bar(target: Message) -> Bar:
    """The bar that an ARM_TARGET describes.

    Raises:
        CommandRejected: it describes something else, in another frame, or with impossible numbers.
    """
    if target.kind != mav.ARM_TARGET_KIND_BAR:
        raise CommandRejected(f"targets of kind {target.kind} are not available")
    if target.frame != mav.MAV_FRAME_LOCAL_NED:
        raise CommandRejected(f"frame {target.frame} is not MAV_FRAME_LOCAL_NED")
    x, y, z = target.position
    if not all(math.isfinite(c) and abs(c) <= _FARTHEST_M for c in (x, y, z)):
        raise CommandRejected(f"position is not finite or beyond {_FARTHEST_M:g} m")
    a, b, c = target.axis
    length = math.hypot(a, b, c)
    if not (math.isfinite(length) and length >= _SHORTEST_AXIS):
        raise CommandRejected("axis has no direction")
    lower, upper = _RADII_M
    if not lower <= target.radius <= upper:
        raise CommandRejected(f"radius {target.radius:g} m is outside {lower:g} to {upper:g} m")
    return Bar((x, y, z), (a / length, b / length, c / length), target.radius)
