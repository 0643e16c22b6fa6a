"""The plant's truth beside the daemon's record, for the report."""

from collections.abc import Callable, Iterable
from pathlib import Path

from arm_companion.record.mcap_file import McapFile
from arm_companion.record.topics import FORMAT, TRUTH
from arm_companion.sim.world import Sample


def write_truth(path: Path, samples: Iterable[Sample], unix: Callable[[float], float]) -> None:
    """Write the truth as a record of its own.

    Args:
        path: of the MCAP file.
        samples: with the loop times that the daemon has too.
        unix: Unix time, s, of a loop time.

    Raises:
        OSError: the disk does not take it.
    """
    file = McapFile(path, {"format": FORMAT, "content": "truth"})
    try:
        for sample in samples:
            truth = sample.truth
            value = {
                "t": sample.t,
                "position_w": [float(x) for x in sample.state.position_w],
                "force_b": [float(x) for x in truth.force_b],
                "torque_b": [float(x) for x in truth.torque_b],
                "tension": [float(x) for x in truth.tension],
                "contact_force_n": float(truth.contact_force_n),
                "wrap_angle": float(truth.wrap_angle),
            }
            file.json(TRUTH, round(unix(sample.t) * 1e9), value)
    finally:
        file.close()
