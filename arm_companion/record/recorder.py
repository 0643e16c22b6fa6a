"""What the daemon tells whoever records it; nothing here ever waits."""

from dataclasses import dataclass
from typing import NamedTuple

from arm_companion.config.schema import Config
from arm_companion.errors import in_words, place
from arm_companion.last_writes import Ending, wait_for
from arm_companion.mission.facts import Commands, Facts, Notice
from arm_companion.mission.state import State


@dataclass(frozen=True, slots=True)
class Record:
    """One cycle: what was known, what was remembered before, and what was asked for."""

    t: float  # loop time, s
    facts: Facts
    state: State
    commands: Commands


@dataclass(frozen=True, slots=True)
class FailedCycle:
    """One cycle whose step raised; the memory before it is that after it too."""

    t: float  # loop time, s
    facts: Facts
    state: State
    error: str
    """What was raised, in words."""
    where: str
    """The place in this package, "MODULE:LINE in FUNCTION"."""


class Frame(NamedTuple):
    """Bytes that passed over a link or the servo bus at once."""

    t: float  # loop time, s
    pipe: str  # "mavlink/NAME" or "servos"
    sent: bool
    data: bytes


def failed_cycle(t: float, facts: Facts, state: State, error: Exception) -> FailedCycle:
    """A cycle that has just raised this."""
    return FailedCycle(t, facts, state, in_words(error), place(error))


class Recorder:
    """Records nothing; the others override what they keep. All times are the loop's, s."""

    raw = False
    """Whether frames are wanted."""

    def configure(self, t: float, config: Config) -> None:
        """This configuration is in force from now on."""

    def mechanics(self, name: str) -> None:
        """The mechanics run on this, such as "numpy"; told before the first cycle."""

    def put(self, record: Record) -> None:
        """Take one cycle."""

    def failed(self, cycle: FailedCycle) -> None:
        """Take one cycle that commanded nothing."""

    def notice(self, t: float, notice: Notice) -> None:
        """Take one sentence for people."""

    def frame(self, frame: Frame) -> None:
        """Take raw bytes."""

    def troubles(self) -> list[str]:
        """What people should know of the recording itself, once each."""
        return []

    def end(self) -> list[Ending]:
        """Have what is left written, and stop; nothing waits here. What is to be waited for."""
        return []

    def close(self) -> None:
        """Write what is left and stop."""
        wait_for(self.end())


class MemoryRecorder(Recorder):
    """Keeps all cycles, for tests and simulated time."""

    def __init__(self) -> None:
        self.records: list[Record] = []

    def put(self, record: Record) -> None:
        """Keep it."""
        self.records.append(record)


class Both(Recorder):
    """Hands everything to several recorders."""

    def __init__(self, *recorders: Recorder) -> None:
        self._recorders = recorders
        self.raw = any(recorder.raw for recorder in recorders)

    def configure(self, t: float, config: Config) -> None:
        """See `Recorder`."""
        for recorder in self._recorders:
            recorder.configure(t, config)

    def mechanics(self, name: str) -> None:
        """See `Recorder`."""
        for recorder in self._recorders:
            recorder.mechanics(name)

    def put(self, record: Record) -> None:
        """See `Recorder`."""
        for recorder in self._recorders:
            recorder.put(record)

    def failed(self, cycle: FailedCycle) -> None:
        """See `Recorder`."""
        for recorder in self._recorders:
            recorder.failed(cycle)

    def notice(self, t: float, notice: Notice) -> None:
        """See `Recorder`."""
        for recorder in self._recorders:
            recorder.notice(t, notice)

    def frame(self, frame: Frame) -> None:
        """See `Recorder`."""
        for recorder in self._recorders:
            recorder.frame(frame)

    def troubles(self) -> list[str]:
        """See `Recorder`."""
        return [text for recorder in self._recorders for text in recorder.troubles()]

    def end(self) -> list[Ending]:
        """See `Recorder`."""
        return [ending for recorder in self._recorders for ending in recorder.end()]
