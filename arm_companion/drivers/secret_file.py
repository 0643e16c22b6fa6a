"""Files with secrets that the configuration names."""

import os
from pathlib import Path

from arm_companion.errors import ConfigError


def check_file(key: str, path: Path, *, secret: bool) -> None:
    """That a file can be read, and a secret one by nobody else.

    Args:
        key: of the configuration, for the message.
        path: the file.
        secret: whether others must not be able to read it.

    Raises:
        ConfigError: when not, with key and path.
    """
    try:
        with path.open("rb") as stream:
            mode = os.fstat(stream.fileno()).st_mode
    except OSError as error:
        raise ConfigError(f"{key} {path}: {error.strerror}") from None
    if secret and mode & 0o007:
        raise ConfigError(f"{key} {path}: others may use it (mode {mode & 0o777:04o}); chmod 640 {path}")
