"""Where the mechanics go on from: what a prediction remembers besides what stands in the record with every cycle.

It is some kilobytes, so it is recorded once in a while. With it a replay goes on bit for bit from there.
"""

from dataclasses import dataclass

import orjson

from arm_companion.arm.model import ArmModel
from arm_companion.arm.rod_model import RodModel
from arm_companion.arm.rod_start import RodStart, start_of
from arm_companion.mission.facts import StiffnessReport
from arm_companion.mission.state import State
from arm_companion.record_codec import build, plain
from arm_companion.values import replace


@dataclass(frozen=True)
class Starts:
    """The last equilibria, and the stiffness that was found with them."""

    free: RodStart | None
    anchored: RodStart | None
    stiffness: StiffnessReport | None


def starts_text(state: State, t: float) -> bytes:
    """The text of what this memory starts from at loop time `t`."""
    last = state.prediction
    kept = Starts(None, None, None)
    if last is not None:
        kept = Starts(start_of(last.free), start_of(last.anchored), last.stiffness)
    return orjson.dumps({"t": t} | plain(kept))


def started(state: State, text: bytes, model: ArmModel) -> State:
    """Recorded memory, with what `starts_text` wrote of it.

    Raises:
        ValueError: the text is of another version.
    """
    if state.prediction is None or not isinstance(model, RodModel):
        return state
    table = orjson.loads(text)
    table.pop("t", None)
    kept = build(Starts, table)
    return replace(
        state,
        prediction=replace(
            state.prediction,
            free=None if kept.free is None else model.resumed(kept.free),
            anchored=None if kept.anchored is None else model.resumed(kept.anchored),
            stiffness=kept.stiffness,
        ),
    )
