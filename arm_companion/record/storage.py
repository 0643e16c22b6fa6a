"""Names of a record's parts, and the disk that they may take."""

import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Final

_OURS: Final = re.compile(r"\d{8}-\d{6}(-\d{3,})?\.mcap")
_MB: Final = 1_000_000


def part(first: Path, number: int) -> Path:
    """File of a part, counted from 1; the first part has the record's own name."""
    return first if number == 1 else first.with_name(f"{first.stem}-{number:03d}{first.suffix}")


def first_of(path: Path) -> tuple[Path, int]:
    """The first part of a part's record and the part's own number, as far as its name tells."""
    match = re.fullmatch(r"(.+)-(\d{3,})", path.stem)
    # 20260101-120000 is a start, not part 120000
    if match is None or (_OURS.fullmatch(path.name) and match[2] == path.stem[9:]):
        return path, 1
    return path.with_name(f"{match[1]}{path.suffix}"), int(match[2])


def following(path: Path) -> Path:
    """The part after this one, as far as its name tells."""
    first, number = first_of(path)
    return part(first, number + 1)


def oldest_left(first: Path) -> Path | None:
    """The first of a record's parts that still is there, once its first one was deleted; None: there is none."""
    ours = re.compile(re.escape(first.stem) + r"-(\d{3,})" + re.escape(first.suffix))
    try:
        found = [(int(match[1]), file) for file in first.parent.iterdir() if (match := ours.fullmatch(file.name))]
    except OSError:
        return None
    return min(found)[1] if found else None


def make_room(first: Path, present: Path, part_mb: float, budget_mb: float, keep_free_mb: float) -> list[Path]:
    """Delete the oldest records until budget and free space are kept; the present part stays.

    Only files are looked at whose names this program gives: the parts of this record, and in a directory of
    records all that are called after their start.

    Args:
        first: the first part of the record.
        present: the part that is being written.
        part_mb: what it will take in the end, MB.
        budget_mb: most that all of them may take, MB; 0: any.
        keep_free_mb: least to leave free on the disk, MB.

    Returns:
        What was deleted.

    Raises:
        OSError: the directory cannot be read, or a file not deleted.
    """
    others = (file for file in _candidates(first) if file != present)
    files = sorted(others, key=lambda file: (file.stat().st_mtime_ns, file.name))
    total = part_mb * _MB + sum(file.stat().st_size for file in files)
    gone = []
    for file in files:
        over = budget_mb and total > budget_mb * _MB
        if not over and shutil.disk_usage(first.parent).free > keep_free_mb * _MB:
            break
        total -= file.stat().st_size
        file.unlink()
        gone.append(file)
    return gone


def free_mb(directory: Path) -> float:
    """Free space of the disk, MB.

    Raises:
        OSError: there is no such directory.
    """
    return shutil.disk_usage(directory).free / _MB


def _candidates(first: Path) -> Iterable[Path]:
    own = re.compile(re.escape(first.stem) + r"(-\d{3,})?" + re.escape(first.suffix))
    for file in first.parent.iterdir():
        if own.fullmatch(file.name) or (_OURS.fullmatch(first.name) and _OURS.fullmatch(file.name)):
            yield file
