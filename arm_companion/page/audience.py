"""Who looks at the page: each gets the newest of every kind at his own pace, and all sentences and answers."""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Final

_ONE_BY_ONE: Final = frozenset({"events", "answer"})
"""Topics of which every message counts."""
_LASTING: Final = frozenset({"setup", "limits"})
"""Topics that hold until they are told again. What the arm does is old a moment later, and nobody is told it as new."""
_KEPT: Final = 50


class Viewer:
    """What one browser has not been sent yet."""

    def __init__(self) -> None:
        self._newest: dict[str, str] = {}
        self._each: deque[tuple[str, str]] = deque(maxlen=2 * _KEPT)
        self._filled = asyncio.Event()

    def put(self, topic: str, payload: str) -> None:
        """Something new; it takes the place of what is outdated by it."""
        if topic in _ONE_BY_ONE:
            self._each.append((topic, payload))
        else:
            self._newest[topic] = payload
        self._filled.set()

    async def take(self, within_s: float) -> list[tuple[str, str]]:
        """All that is new, as soon as there is something; nothing when there is nothing for so long."""
        try:
            async with asyncio.timeout(within_s):
                await self._filled.wait()
        except TimeoutError:
            return []
        self._filled.clear()
        found = [*self._newest.items(), *self._each]
        self._newest.clear()
        self._each.clear()
        return found


class Audience:
    """All who look.

    Args:
        counted: told how many there are when that changes.
    """

    def __init__(self, counted: Callable[[int], None]) -> None:
        self._counted = counted
        self._viewers: set[Viewer] = set()
        self._lasting: dict[str, str] = {}
        self._said: deque[str] = deque(maxlen=_KEPT)

    def __len__(self) -> int:
        return len(self._viewers)

    def put(self, topic: str, payload: str) -> None:
        """A message of the daemon's, for everybody and for who comes later."""
        if topic == "events":
            self._said.append(payload)
        elif topic in _LASTING:
            self._lasting[topic] = payload
        for viewer in self._viewers:
            viewer.put(topic, payload)

    def join(self) -> Viewer:
        """Somebody begins to look: he is told what holds and what was said lately."""
        viewer = Viewer()
        for topic, payload in self._lasting.items():
            viewer.put(topic, payload)
        for payload in self._said:
            viewer.put("events", payload)
        self._viewers.add(viewer)
        self._counted(len(self))
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """He looks no more."""
        self._viewers.discard(viewer)
        self._counted(len(self))
