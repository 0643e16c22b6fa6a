"""Medians of what takes turns with a peer."""

import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

Work = Callable[[], object]


@dataclass(frozen=True)
class Result:
    """One measurement beside one peer, or beside none."""

    name: str
    value: float
    unit: str
    peer: str | None = None
    peer_value: float | None = None

    @property
    def ratio(self) -> float | None:
        if self.peer_value is None or self.value == 0:
            return None
        return self.peer_value / self.value

    def plain(self) -> dict[str, object]:
        return {**dataclasses.asdict(self), "ratio": self.ratio}

    def line(self) -> str:
        peer = "" if self.peer_value is None else f"{self.peer_value:.4g}"
        ratio = "" if self.ratio is None else f"{self.ratio:.2f}"
        return f"{self.name:<44}{self.value:>11.4g} {self.unit:<6}{peer:>11}  {ratio:>8}  {self.peer or ''}"


def seconds(work: Work, batch: int = 1) -> float:
    """Mean time of one call in a batch."""
    begun = time.perf_counter()
    for _ in range(batch):
        work()
    return (time.perf_counter() - begun) / batch


def medians(rounds: int, *works: tuple[Work, int, int]) -> list[float]:
    """Median time of one call of each, s; the works take turns.

    Args:
        rounds: turns.
        works: each with its number of samples in a turn, and of calls in a sample (for what is too short to time).
    """
    for work, _, _ in works:
        work()
    taken: list[list[float]] = [[] for _ in works]
    for _ in range(rounds):
        for samples, (work, count, batch) in zip(taken, works, strict=True):
            samples += [seconds(work, batch) for _ in range(count)]
    return [statistics.median(samples) for samples in taken]
