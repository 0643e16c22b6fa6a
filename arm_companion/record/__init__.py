"""The record of a flight: an MCAP file that today's code can be run against, and that Foxglove and PlotJuggler read."""

import importlib.util
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from arm_companion.clock import Clock
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError, RecordError
from arm_companion.record.recorder import Recorder

_NEEDS: Final = ("mcap", "orjson")


def require() -> None:
    """That what reads and writes records is installed.

    Raises:
        RecordError: it is not; the message says what to do.
    """
    missing = [name for name in _NEEDS if importlib.util.find_spec(name) is None]
    if missing:
        raise RecordError(f"records need {' and '.join(missing)}: pip install 'arm-companion[record]'")


def check_installed(config: Config) -> None:
    """Refuse a configuration that records where nothing can.

    Raises:
        ConfigError: what writes records is not installed; the message says what to do.
    """
    if config.record.file or config.record.directory:
        _check_installed()


def _check_installed() -> None:
    try:
        require()
    except RecordError as error:
        raise ConfigError(f"record: {error}") from None


def configured_recorder(config: Config, clock: Clock) -> Recorder:
    """What [record] asks for.

    Raises:
        ConfigError: what writes records is not installed.
    """
    if not (config.record.file or config.record.directory):
        return Recorder()
    if config.record.file:
        path = Path(config.record.file)
    else:
        start = datetime.fromtimestamp(clock.unix(clock.now()), UTC)
        path = _free_name(Path(config.record.directory), start)
    return open_recorder(path, config, clock)


def _free_name(directory: Path, start: datetime) -> Path:
    """A second later where there is a record already: a computer without a clock may start at the same time again."""
    while True:
        path = directory / f"{start:%Y%m%d-%H%M%S}.mcap"
        try:
            taken = path.exists() or any(directory.glob(f"{path.stem}-*{path.suffix}"))
        except OSError:  # the recorder will tell of it
            return path
        if not taken:
            return path
        start += timedelta(seconds=1)


def open_recorder(path: Path, config: Config, clock: Clock, *, patient: bool = False) -> Recorder:
    """A recorder of the daemon in this file.

    Raises:
        ConfigError: what writes records is not installed.
    """
    _check_installed()
    from arm_companion.record.file_recorder import FileRecorder  # noqa: PLC0415 - of an extra
    from arm_companion.record.versions import versions  # noqa: PLC0415

    return FileRecorder(path, config.record, versions(config), clock.unix, patient=patient)
