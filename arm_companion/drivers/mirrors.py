"""The essentials in messages that every ground station plots, for people with nothing of ours.

NAMED_VALUE_FLOAT has a name of ten characters; DEBUG_FLOAT_ARRAY has all in one message. Both pass any autopilot.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Final

from arm_companion.mission.facts import StatusReport, TendonState, WrenchReport
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

ARRAY_NAME: Final = b"arm"
ARRAY_ID: Final = 1
_ARRAY: Final = 58
_MOST_TENDONS: Final = 8

NAMES: Final = ("arm_state", "arm_prog", "arm_theta", "arm_delta", "arm_fx", "arm_fy", "arm_fz", "arm_mx", "arm_my",
                "arm_mz", "arm_valid", "arm_tmax", "arm_error")  # fmt: skip
"""Names of the values, in the order in which they are sent."""


def mirror_values(
    boot_ms: int, status: StatusReport, tendons: Sequence[TendonState], wrench: WrenchReport
) -> Iterator[Message]:
    """NAMED_VALUE_FLOATs.

    Args:
        boot_ms: time stamp, ms.
        status: state, progress (per cent), bend (rad), error bits.
        tendons: the greatest tension, N.
        wrench: on the airframe, N and N m; it counts where arm_valid is 1.
    """
    numbers = (
        status.state_number,
        status.progress,
        status.theta,
        status.delta,
        *wrench.force_b,
        *wrench.torque_b,
        wrench.valid,
        max((tendon.tension for tendon in tendons), default=math.nan),
        status.error_bits,
    )
    for name, number in zip(NAMES, numbers, strict=True):
        yield mav.MAVLink_named_value_float_message(boot_ms, name.encode(), float(number))


def mirror_array(stamp: int, status: StatusReport, tendons: Sequence[TendonState], wrench: WrenchReport) -> Message:
    """DEBUG_FLOAT_ARRAY "arm": state, progress, theta, delta, force 3, torque 3, their sigmas 3 + 3, valid, tensions.

    Args:
        stamp: Unix time, us.
        status: state, progress (per cent), bend (rad).
        tendons: tensions, N, of up to eight.
        wrench: on the airframe, N and N m.
    """
    numbers = [
        float(number)
        for number in (
            status.state_number,
            status.progress,
            status.theta,
            status.delta,
            *wrench.force_b,
            *wrench.torque_b,
            *wrench.force_sigma,
            *wrench.torque_sigma,
            wrench.valid,
            *(tendon.tension for tendon in tendons[:_MOST_TENDONS]),
        )
    ]
    return mav.MAVLink_debug_float_array_message(stamp, ARRAY_NAME, ARRAY_ID, numbers + [0.0] * (_ARRAY - len(numbers)))
