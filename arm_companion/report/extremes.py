"""The greatest values of a flight, of every cycle in its record."""

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from arm_companion.mission.state import MOVES_VEHICLE

_FLYING: Final = frozenset(phase.name for phase in MOVES_VEHICLE)


class Most(NamedTuple):
    """The greatest of a quantity, nan before the first, and its sigma."""

    value: float = math.nan
    sigma: float = math.nan

    def text(self, digits: int, unit: str) -> str:
        """Both in words."""
        if math.isnan(self.value):
            return "not known"
        sigma = f" ± {self.sigma:.{digits}f}" if math.isfinite(self.sigma) else ""
        return f"{self.value:.{digits}f}{sigma} {unit}"


_NONE: Final = Most()


@dataclass
class Extremes:
    """Of every cycle, not only of those that are drawn."""

    tension: Most = _NONE  # N, by load
    force: Most = _NONE  # N
    torque: Most = _NONE  # N m
    temperature: float = math.nan  # degC
    voltage: float = math.nan  # V, the lowest
    error_bits: int = 0  # while the arm flew a perch, and of what ended that
    flew: bool = False  # in the last cycle

    def see(self, facts: dict[str, Any], commands: dict[str, Any]) -> None:
        """One more cycle."""
        for tendon in facts["tendons"]:
            if not isinstance(tendon["age_s"], float):  # never heard
                continue
            self.tension = _greater(self.tension, float(tendon["tension"]), float(tendon["tension_sigma"]))
            self.temperature = max(float(tendon["temperature"]), self.temperature)  # the second loses while it is nan
            self.voltage = min(float(tendon["voltage"]), self.voltage)
        wrench = commands["wrench"]
        if wrench["valid"]:
            self.force = _greater(self.force, *_length(wrench["force_b"], wrench["force_sigma"]))
            self.torque = _greater(self.torque, *_length(wrench["torque_b"], wrench["torque_sigma"]))
        flies = commands["status"]["state"] in _FLYING
        if flies or self.flew:
            self.error_bits |= commands["status"]["error_bits"]
        self.flew = flies


def _greater(most: Most, value: float, sigma: float) -> Most:
    return Most(value, sigma) if value > most.value or (math.isnan(most.value) and math.isfinite(value)) else most


def _length(vector: list[Any], sigmas: list[Any]) -> tuple[float, float]:
    """Length of a vector, and its sigma."""
    values = [float(x) for x in vector]
    length = math.hypot(*values)
    along = (x * float(sigma) for x, sigma in zip(values, sigmas, strict=True))
    return length, math.hypot(*along) / length if length > 0.0 else max(map(float, sigmas))
