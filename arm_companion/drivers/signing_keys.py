"""Signing keys and time stamps on disk.

A time stamp must not be used twice, also after a power cut and with a clock that is wrong then. So while the daemon
runs the file has a stamp that will not be passed before the file is written again; a restart goes on behind it. Stamps
that are ahead of the clock must not get farther ahead with each restart, or a ground station with the right time is
locked out after some: what is reserved counts from the clock, and beyond that only for the frames sent meanwhile.
"""

import logging
import stat
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from arm_companion.clock import Clock, ticks
from arm_companion.config.schema import Config
from arm_companion.drivers.keeper import Keeper
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.settings import state_directory
from arm_companion.errors import ConfigError
from arm_companion.protocol.signing import KEY_LENGTH, UNITS_PER_S, Signing, Streams, stamp_at

log = logging.getLogger(__name__)

KEEP_EVERY_S: Final = 10.0
"""How often the time stamps are written."""

_RESERVED: Final = int(2 * KEEP_EVERY_S * UNITS_PER_S)
_LEAST_RESERVED: Final = UNITS_PER_S  # as many frames, each of which uses one stamp


def read_key(path: Path) -> bytes:
    """The signing key in a file: 32 bytes, or 64 hexadecimal digits.

    Raises:
        ConfigError: the file is missing, readable for others, or no key.
    """
    try:
        mode = path.stat().st_mode
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"signing_key {path}: {error.strerror}") from None
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"signing_key {path}: others may use it (mode {stat.S_IMODE(mode):04o}); chmod 600 {path}")
    if len(data) == KEY_LENGTH:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != KEY_LENGTH:
        raise ConfigError(f"signing_key {path}: neither {KEY_LENGTH} bytes nor {2 * KEY_LENGTH} hexadecimal digits")
    return key


class SigningKeys:
    """Gives each link that has a key its signing, and keeps the time stamps.

    Args:
        config: which link has which key file, and where time stamps are kept.
        keeper: writes them.

    Raises:
        ConfigError: a key cannot be used.
    """

    def __init__(self, config: Config, keeper: Keeper) -> None:
        self._keeper = keeper
        self._directory = state_directory(config)
        self._unix: Callable[[], float] = lambda: 0.0
        self._kept: dict[Path, Signing] = {}
        self._last: dict[Path, int] = {}  # stamps at the last writing
        self._by_link: dict[str, Signing] = {}
        heard: dict[bytes, Streams] = {}
        for number, (name, link) in enumerate(config.links.items()):
            if not link.signing_key:
                continue
            stamp = 0
            if self._directory is None:
                log.warning("link %s: signing time stamps are not kept: set mavlink.state_directory", name)
            else:
                stamp = _read_stamp(self._directory / f"signing-{name}")
            key = read_key(Path(link.signing_key))
            signing = Signing(key, number, stamp, heard.setdefault(key, {}))
            self._by_link[name] = signing
            if self._directory is not None:
                file = self._directory / f"signing-{name}"
                self._kept[file], self._last[file] = signing, stamp

    def secure(self, links: Sequence[MavlinkLink], clock: Clock) -> None:
        """Sign on those links that have a key."""
        self._unix = lambda: clock.unix(clock.now())
        for link in links:
            if (signing := self._by_link.get(link.name)) is not None:
                link.secure(signing, self._unix)

    async def run(self) -> None:
        """Reserve time stamps again and again, until cancelled."""
        async for _ in ticks(KEEP_EVERY_S):
            for file, signing in self._kept.items():
                # a peer whose clock is ahead pulls ours along as fast as it goes
                pace = 2 * (signing.stamp - self._last[file])
                ahead = signing.stamp + min(max(pace, _LEAST_RESERVED), _RESERVED)
                self._last[file] = signing.stamp
                self._put(file, max(ahead, stamp_at(self._unix()) + _RESERVED))

    def keep(self) -> None:
        """Write the time stamps at the end, when none is used any more: what was reserved is free again."""
        for file, signing in self._kept.items():
            self._put(file, signing.stamp)

    def _put(self, file: Path, stamp: int) -> None:
        self._keeper.put(file, str(stamp).encode() + b"\n")


def _read_stamp(file: Path) -> int:
    try:
        return int(file.read_text(encoding="ascii"))
    except FileNotFoundError:
        return 0
    except (OSError, ValueError) as error:
        log.warning("%s is left aside: %s", file, error)
        return 0
