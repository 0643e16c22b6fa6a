"""The file of custom actions that QGroundControl shows as buttons in its fly view, made from the dialect."""

import json
from typing import Any, Final

from arm_companion.protocol.dialect import mav

_BUTTONS: Final = (
    ("Arm: ready", mav.MAV_CMD_ARM_READY, ()),
    ("Arm: perch", mav.MAV_CMD_ARM_PERCH, (mav.ARM_PERCH_KIND_ANCHOR,)),
    ("Arm: hang", mav.MAV_CMD_ARM_PERCH, (mav.ARM_PERCH_KIND_HANG,)),
    ("Arm: grasp", mav.MAV_CMD_ARM_GRASP, ()),
    ("Arm: release", mav.MAV_CMD_ARM_RELEASE, ()),
    ("Arm: stow", mav.MAV_CMD_ARM_STOW, ()),
    ("Arm: ABORT", mav.MAV_CMD_ARM_ABORT, ()),
    ("Arm: clear errors", mav.MAV_CMD_ARM_CLEAR_ERRORS, ()),
    ("Arm: feed-forward on", mav.MAV_CMD_ARM_FEEDFORWARD, (1,)),
    ("Arm: feed-forward off", mav.MAV_CMD_ARM_FEEDFORWARD, (0,)),
)
"""Label, command, first parameters. JOG and CALIBRATE want numbers and a person who looks: they are no buttons."""


def actions(component: int = 192) -> dict[str, Any]:
    """The content of the file.

    Args:
        component: component id of the arm.
    """
    return {
        "version": 1,
        "fileType": "MavlinkActions",
        "actions": [
            {
                "label": label,
                "description": " ".join(mav.enums["MAV_CMD"][command].description.split()),
                "mavCmd": command,
                "compId": component,
                # All seven: QGroundControl's own default is 0 as well, but the file then says what is sent.
                **{f"param{i}": given for i, given in enumerate((*given_first, *[0] * (7 - len(given_first))), 1)},
            }
            for label, command, given_first in _BUTTONS
        ],
    }


def as_text(component: int = 192) -> str:
    """The file."""
    return json.dumps(actions(component), indent=2) + "\n"
