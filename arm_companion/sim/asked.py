"""Where the vehicle was asked to be, read from the daemon's own record: in real time nobody else is told of it all."""

import json
from pathlib import Path

from arm_companion.errors import RecordError
from arm_companion.record.reader import Reader
from arm_companion.record.topics import COMMANDS
from arm_companion.sim.flight import Vec3


def asked(record: Path) -> list[tuple[float, Vec3]]:
    """Loop time and position, m, world axes, of every set-point; none when the record cannot be read.

    Args:
        record: of a daemon on this machine, whose loop has this machine's monotonic clock.
    """
    try:
        commands = [json.loads(item.data) for item in Reader(record).messages({COMMANDS})]
    except (OSError, RecordError, ValueError):
        return []
    return [(float(c["t"]), _vec3(c["setpoint"]["position_w"])) for c in commands if c["setpoint"] is not None]


def _vec3(numbers: list[float]) -> Vec3:
    x, y, z = numbers
    return float(x), float(y), float(z)
