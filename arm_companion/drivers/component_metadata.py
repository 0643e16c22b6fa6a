"""What ground stations can learn of our component: the general and the parameter metadata file, as JSON."""

import json
from typing import Any, Final

from arm_companion.config.parameters import PARAMETERS, Parameter, When
from arm_companion.config.schema import Config
from arm_companion.protocol.ftp import crc32

GENERAL: Final = "/general.json"
PARAMETER: Final = "/parameter.json"
_TYPE_PARAMETER: Final = 1  # COMP_METADATA_TYPE_PARAMETER
_GROUPS: Final = {"perch": "Perch", "limits": "Limits", "vehicle": "Vehicle", "rates": "Rates", "mavlink": "MAVLink"}


def metadata_files(component_id: int) -> dict[str, bytes]:
    """The files by path.

    Args:
        component_id: ours, for the addresses inside.
    """
    parameters = _json({"version": 1, "parameters": [_describe(parameter) for parameter in PARAMETERS]})
    general = _json(
        {
            "version": 1,
            "metadataTypes": [
                {"type": _TYPE_PARAMETER, "uri": uri(component_id, PARAMETER), "fileCrc": crc32(parameters)}
            ],
        }
    )
    return {GENERAL: general, PARAMETER: parameters}


def uri(component_id: int, path: str) -> str:
    """Address of a file on our MAVLink FTP server."""
    return f"mftp://[;comp={component_id}]{path}"


def _describe(parameter: Parameter) -> dict[str, Any]:
    option = parameter.option
    described: dict[str, Any] = {
        "name": parameter.name,
        "type": "Int32" if parameter.whole else "Float",
        "shortDesc": option.doc,
        "longDesc": f"{option.doc}. Option {parameter.path}; takes effect {parameter.when.value}.",
        "group": _GROUPS.get(parameter.section, parameter.section),
        "default": parameter.read(Config()),
        "min": option.lower,
        "max": option.upper,
        "rebootRequired": parameter.when is When.RESTART,
    }
    if option.unit:
        described["units"] = option.unit
    if not parameter.whole:
        described["decimalPlaces"] = 4
    return described


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()
