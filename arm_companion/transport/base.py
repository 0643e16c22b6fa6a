"""What every transport is: a pipe for bytes that never blocks and says when it is gone."""

from collections.abc import Awaitable, Callable
from typing import Protocol

Receiver = Callable[[bytes], None]
"""Called on the event loop with every chunk that arrives; it must not block and must not raise."""


class Transport(Protocol):
    """An open byte pipe."""

    def write(self, data: bytes) -> None:
        """Send `data` without waiting. What the peer cannot take is dropped, oldest first, and counted."""

    def close(self) -> None:
        """Release the device or socket; a second call does nothing."""

    async def wait_closed(self) -> None:
        """Return when the pipe is gone, by `close` or by loss (cable out, device unplugged)."""

    @property
    def dropped(self) -> int:
        """Chunks that were not sent because the peer did not take them."""


Opener = Callable[[Receiver], Awaitable[Transport]]
"""Opens the pipe once. Raises `LinkError` when that is not possible now; the owner tries again later."""
