"""`arm-companion report`: one page of a recorded flight."""

import argparse
import importlib.util
import json
import sys
from pathlib import Path

from arm_companion.errors import RecordError
from arm_companion.record import require


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion report`."""
    parser.add_argument("log", type=Path, metavar="LOG", help="a record (*.mcap); the parts that follow it come along")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="for report.html and the PNGs (default: LOG without .mcap, or LOG-report)",
    )
    parser.add_argument("--truth", type=Path, metavar="FILE", help="the simulator's truth (default: beside LOG)")
    parser.add_argument("--title", help="headline of the page (default: the record's name)")
    parser.add_argument("--json", action="store_true", help="print the verdict as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Write the page and its pictures."""
    require()
    if importlib.util.find_spec("matplotlib") is None:
        print("arm-companion report needs 'matplotlib': pip install 'arm-companion[report]'", file=sys.stderr)
        return 2
    from arm_companion.record.reader import Reader  # noqa: PLC0415 - after the check for the extra
    from arm_companion.report.figures import pictures  # noqa: PLC0415
    from arm_companion.report.flight import read  # noqa: PLC0415
    from arm_companion.report.page import page  # noqa: PLC0415
    from arm_companion.report.words import judge  # noqa: PLC0415

    log: Path = arguments.log
    record, truth = Reader(log), None
    if arguments.truth:
        truth = Reader(arguments.truth)
    elif (beside := _truth_of(log)) is not None:
        try:
            truth = Reader(beside)
        except RecordError as error:  # the simulator was stopped as it wrote it; the flight is worth a page
            record.remarks.append(str(error))
    flight = read(record, truth)
    verdict = judge(flight)
    output: Path = arguments.output or _beside(log)
    drawn = pictures(flight)
    file = output / "report.html"
    written = (file, *(output / f"{picture.name}.png" for picture in drawn))
    if any(path.exists() and path.samefile(log) for path in written):
        print(f"arm-companion report: {log} would be overwritten; name another folder with --output", file=sys.stderr)
        return 1
    try:
        output.mkdir(parents=True, exist_ok=True)
        for picture in drawn:
            (output / f"{picture.name}.png").write_bytes(picture.png)
        file.write_text(page(flight, verdict, drawn, arguments.title or f"Flight {log.stem}"), encoding="utf-8")
    except OSError as error:
        print(f"arm-companion report: {error.filename or output}: {error.strerror}", file=sys.stderr)
        return 1
    if arguments.json:
        found = {"grade": verdict.grade, "headline": verdict.headline, "points": verdict.points, "page": str(file)}
        print(json.dumps(found))
    else:
        print(verdict.headline)
        for point in verdict.points:
            print(f"  {point}")
        print(file)
    return 0


def _truth_of(log: Path) -> Path | None:
    """The simulator's truth of a record or of one of its parts, which have one together; None: there is none."""
    from arm_companion.record.reader import truth_beside  # noqa: PLC0415 - after the check for the extra
    from arm_companion.record.storage import first_of  # noqa: PLC0415

    return next((file for file in map(truth_beside, (log, first_of(log)[0])) if file.is_file()), None)


def _beside(log: Path) -> Path:
    """Where the page of a record goes: a name of its own even where the record's has no ending to leave out."""
    return log.with_suffix("") if log.suffix == ".mcap" else log.with_name(f"{log.name}-report")
