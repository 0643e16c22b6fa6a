"""The ground side: an arm that flies somewhere else, heard and commanded over MAVLink by way of MAVSDK.

`Arm` is what to begin with; docs/ground.md has an example. It needs the extra `ground`.
"""

from arm_companion.ground.arm import DEFAULT_URL, Arm
from arm_companion.ground.channel import ArmSilent
from arm_companion.ground.commands import CommandFailed, CommandUnfinished
from arm_companion.ground.parameters import Parameter, ParameterRefused
from arm_companion.ground.reports import Payload, Report, Status, Tendon, Tendons, Wrench
from arm_companion.ground.texts import Text

__all__ = [
    "DEFAULT_URL",
    "Arm",
    "ArmSilent",
    "CommandFailed",
    "CommandUnfinished",
    "Parameter",
    "ParameterRefused",
    "Payload",
    "Report",
    "Status",
    "Tendon",
    "Tendons",
    "Text",
    "Wrench",
]
