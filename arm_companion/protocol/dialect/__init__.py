"""The generated MAVLink dialect: pymavlink's code for common.xml and for our own messages.

`mav` is the generated module: message classes `mav.MAVLink_<name>_message`, constants such as
`mav.MAV_TYPE_GCS`, and `mav.mavlink_map` from message id to class.
"""

from pathlib import Path

try:
    from arm_companion.protocol.dialect import generated as mav
except ImportError as error:
    if error.name not in ("arm_companion.protocol.dialect", "arm_companion.protocol.dialect.generated"):
        raise
    raise ImportError(
        "the MAVLink dialect has not been generated: install the package (make setup, or pip install -e .)"
    ) from None

XML = Path(__file__).with_name("arm_companion.xml")
"""Definition of the dialect, for ground stations that load definitions at run time."""

__all__ = ["XML", "mav"]
