"""What was seen of one flight: the plant's truth beside what came over MAVLink."""

import bisect
from dataclasses import dataclass, field

from arm_companion.sim.world import Sample

Vec3 = tuple[float, float, float]

WITH, WITHOUT, CARRIED = "grasp", "grasp, not compensated", "carried"
"""Names of the marks of a grasp."""
AT_POINT = "at a point"
"""Name of the marks at which the tip was kept in one place."""

_ASKED_FOR_S = 0.2  # a set-point older than that is asked no more


@dataclass(frozen=True, slots=True)
class WrenchSeen:
    """One ARM_REACTION_WRENCH as the operator received it."""

    t: float
    force_b: Vec3
    torque_b: Vec3
    force_sigma: Vec3
    valid: bool
    source: int


@dataclass(frozen=True, slots=True)
class TendonsSeen:
    """One ARM_TENDONS as the operator received it."""

    t: float
    tension: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PayloadSeen:
    """One ARM_PAYLOAD as the operator received it."""

    t: float
    mass: float
    sigma: float
    valid: bool


@dataclass(frozen=True, slots=True)
class Mark:
    """A span of time in which the operator asked for something to be measured."""

    name: str
    start: float
    end: float
    asked_w: Vec3


@dataclass
class Flight:
    """One flight from take-off to landing; times are the loop's."""

    samples: list[Sample] = field(default_factory=list)
    states: list[tuple[float, str]] = field(default_factory=list)  # entry time and name
    wrenches: list[WrenchSeen] = field(default_factory=list)
    tendons: list[TendonsSeen] = field(default_factory=list)
    payloads: list[PayloadSeen] = field(default_factory=list)
    texts: list[tuple[float, str]] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    asked: list[tuple[float, Vec3]] = field(default_factory=list)
    """Position that the daemon asked of the vehicle at each time that it did, m, world axes."""
    end: float = 0.0

    def spans(self) -> list[tuple[str, float, float]]:
        """Name, entry and exit of every state passed; none where the arm was never heard."""
        if not self.states:
            return []
        times = [t for t, _ in self.states[1:]] + [self.end]
        return [(name, start, end) for (start, name), end in zip(self.states, times, strict=True)]

    @property
    def places(self) -> list[Mark]:
        """The spans in which the tip was kept at a point."""
        return [mark for mark in self.marks if mark.name == AT_POINT]

    def durations(self) -> list[tuple[str, float]]:
        """Name and length, s, of every state passed."""
        return [(name, end - start) for name, start, end in self.spans()]

    def within(self, start: float, end: float) -> list[Sample]:
        """The samples of a span of time."""
        first = bisect.bisect_left(self.samples, start, key=lambda s: s.t)
        last = bisect.bisect_right(self.samples, end, key=lambda s: s.t)
        return self.samples[first:last]

    def sample_at(self, t: float) -> Sample | None:
        """The newest sample at time `t`."""
        i = bisect.bisect_right(self.samples, t, key=lambda s: s.t)
        return self.samples[i - 1] if i else None

    def asked_at(self, t: float) -> Vec3 | None:
        """Where the vehicle was asked to be at time `t`, m; None while nobody asked."""
        i = bisect.bisect_right(self.asked, t, key=lambda pair: pair[0])
        return self.asked[i - 1][1] if i and t - self.asked[i - 1][0] <= _ASKED_FOR_S else None
