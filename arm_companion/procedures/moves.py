"""One move of a procedure, reading by reading: where the goal is now, and when the move is over. Pure."""

from dataclasses import dataclass, replace

from arm_companion.procedures.actions import Move, Refused, Sample, Trace

_SETTLE_M = 0.0003
_SETTLE_S = 1.0
_LOST_M = 0.004  # a servo that is so far behind, after it had the time to arrive, does not follow
_SMOOTHED = 20  # readings
_STARTING = 15  # readings in which a servo gathers speed, which looks like a load


@dataclass(frozen=True, slots=True)
class Moving:
    """A move under way.

    Attributes:
        action: what is asked for.
        start: goals at its beginning, m wound up.
        gone: m of the longest way.
        rested_s: since the goal arrived.
        samples: what was measured.
    """

    action: Move
    start: tuple[float, ...]
    gone: float = 0.0
    rested_s: float = 0.0
    samples: tuple[Sample, ...] = ()

    @property
    def way(self) -> float:
        """Longest way of a tendon, m."""
        return max(abs(goal - begin) for goal, begin in zip(self.action.wound, self.start, strict=True))

    @property
    def goal(self) -> tuple[float, ...]:
        """Where the servos are asked to be now, m wound up."""
        share = self.gone / self.way if self.way > 0.0 else 1.0
        return tuple(b + share * (g - b) for g, b in zip(self.action.wound, self.start, strict=True))

    def on(self, dt: float) -> "Moving":
        """The goal moved on by `dt` seconds."""
        if self.gone < self.way:
            return replace(self, gone=min(self.gone + self.action.speed * dt, self.way))
        return replace(self, rested_s=self.rested_s + dt)

    def measured(self, sample: Sample) -> tuple["Moving", Trace | None]:
        """With one more reading; the trace when the move is over.

        Raises:
            Refused: a servo does not follow.
        """
        now = replace(self, samples=(*self.samples, sample))
        if now.stopped:
            return now, Trace(now.samples, stopped=True)
        if self.gone < self.way:
            return now, None
        off = [abs(w - goal) for w, goal in zip(sample.wound, self.action.wound, strict=True)]
        if max(off) >= _SETTLE_M and self.rested_s <= _SETTLE_S:
            return now, None
        if max(off) > _LOST_M:
            i = off.index(max(off))
            raise Refused(f"the servo of tendon {i + 1} does not follow: it stays {1e3 * off[i]:.0f} mm behind")
        return now, Trace(now.samples)

    @property
    def stopped(self) -> bool:
        """Whether the load has risen as far as ends the move early."""
        stop = self.action.stop
        if stop is None or len(self.samples) < _STARTING + _SMOOTHED:
            return False
        return sum(stop.of(sample.load) for sample in self.samples[-_SMOOTHED:]) / _SMOOTHED > stop.load
