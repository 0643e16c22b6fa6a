"""What an autopilot's parameters should be for the arm, and how to mend what is not. Pure: anything may ask it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from arm_companion.mission.facts import Severity


@dataclass(frozen=True, slots=True)
class Finding:
    """Something about the vehicle that a person should mend."""

    severity: Severity
    what: str
    mend: str
    about: str
    """Name of the parameter or message: one word about each is enough."""

    @property
    def text(self) -> str:
        """One sentence for people."""
        return f"{self.what}: {self.mend}"


@dataclass(frozen=True, slots=True)
class Expectation:
    """What one parameter should be. In the texts `{n}` is the port's number, `{value}` what was found."""

    name: str
    fine: Callable[[float], bool]
    what: str
    mend: str
    instead_of: str = ""
    """Looked at only where the parameter of this name does not exist (older firmware)."""


DEFAULT_INSTANCE: Final = {"px4": 1, "ardupilot": 2}
"""n of MAV_n_* or MAVn_*: TELEM2 on PX4, SERIAL2 on ArduPilot."""

_NO_FORWARD = "the autopilot does not forward from its port to this computer, so ground stations cannot reach the arm"

EXPECTED: Final[Mapping[str, tuple[Expectation, ...]]] = {
    "px4": (
        Expectation("MAV_{n}_FORWARD", lambda v: v == 1, _NO_FORWARD, "set MAV_{n}_FORWARD to 1 and reboot it"),
        Expectation(
            "COM_OF_LOSS_T",
            lambda v: 0.3 <= v <= 3.0,
            "the autopilot leaves OFFBOARD after {value:g} s without set-points",
            "set COM_OF_LOSS_T to 1",
        ),
        Expectation(
            "COM_OBL_RC_ACT",
            lambda v: v == 5,
            "when set-points stop the autopilot moves on although a bar may hold it (COM_OBL_RC_ACT is {value:g})",
            "set COM_OBL_RC_ACT to 5",
        ),
    ),
    "ardupilot": (
        Expectation(
            "MAV{n}_OPTIONS", lambda v: not int(v) & 2, _NO_FORWARD, "clear bit 1 of MAV{n}_OPTIONS and reboot it"
        ),
        Expectation(
            "SERIAL{n}_OPTIONS",
            lambda v: not int(v) & 1024,
            _NO_FORWARD,
            "clear bit 10 of SERIAL{n}_OPTIONS and reboot it",
            instead_of="MAV{n}_OPTIONS",
        ),
        Expectation(
            "SERIAL{n}_PROTOCOL",
            lambda v: v == 2,
            "the autopilot's port to this computer does not speak MAVLink 2",
            "set SERIAL{n}_PROTOCOL to 2 and reboot it",
        ),
        Expectation(
            "GUID_TIMEOUT",
            lambda v: 0.3 <= v <= 5.0,
            "the autopilot brakes {value:g} s after the last set-point",
            "set GUID_TIMEOUT to 3",
        ),
    ),
}


def names(flavour: str, instance: int) -> tuple[str, ...]:
    """The parameters to read.

    Args:
        flavour: "px4" or "ardupilot".
        instance: number of the port; negative is the usual one.
    """
    n = _instance(flavour, instance)
    return tuple(expectation.name.format(n=n) for expectation in EXPECTED[flavour])


def judge(flavour: str, instance: int, values: Mapping[str, float]) -> list[Finding]:
    """What is wrong with an autopilot's parameters.

    Args:
        flavour: "px4" or "ardupilot".
        instance: number of the port; negative is the usual one.
        values: what could be read, by name. A parameter that is missing is not judged: not every firmware has each.
    """
    n = _instance(flavour, instance)
    findings = []
    for expectation in EXPECTED[flavour]:
        name = expectation.name.format(n=n)
        value = values.get(name, math.nan)
        superseded = expectation.instead_of.format(n=n) in values
        if math.isnan(value) or superseded or expectation.fine(value):
            continue
        what, mend = (text.format(n=n, value=value) for text in (expectation.what, expectation.mend))
        findings.append(Finding(Severity.WARNING, what, mend, name))
    return findings


def judge_rates(rates: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """What is wrong with streams that stay too slow.

    Args:
        rates: by message, the rate that was asked for and the one that comes, Hz.
    """
    mend = "give the autopilot's port a higher baud or data rate, or lower vehicle.state_rate_hz"
    return [
        Finding(Severity.WARNING, f"{name} comes at {got:.0f} Hz, {asked:g} are asked for", mend, name)
        for name, (asked, got) in rates.items()
    ]


def _instance(flavour: str, instance: int) -> int:
    return DEFAULT_INSTANCE[flavour] if instance < 0 else instance
