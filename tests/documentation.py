"""The commands of the documentation, and how the tests run each."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PAGES: Final = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").glob("*.md") if p.name != "cli.md")]
_BLOCK = re.compile(r"^```(\S*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_PREFIX = re.compile(r"^(?:\$ )?(?:sudo )?(?:\.venv/bin/|/opt/arm-companion/venv/bin/)?arm-companion (?=[a-z-])")

HARMLESS: Final = "computes in a moment"
ALONE: Final = "needs nothing, and time"
IN_A_WORLD: Final = "talks to an arm in the simulated world"
BEGIN: Final = "begins in real time, and ends when told"
ON_A_BUS: Final = "talks to servos"

GROUPS: Final = {
    "--version": HARMLESS,
    "config ": HARMLESS,
    "model pose": HARMLESS,
    "model tensions": HARMLESS,
    "model deflect": HARMLESS,
    "model clamp": HARMLESS,
    "model stiffness ": HARMLESS,
    "model ": ALONE,
    "calibrate stiffness": ALONE,
    "replay ": ALONE,
    "report ": ALONE,
    "ground ": IN_A_WORLD,
    "servos monitor": ON_A_BUS,
    "run ": BEGIN,
    "doctor": BEGIN,
    # who else runs them, and why they are not run as they stand
    "sim perch --sitl": "tests/sitl: a flight stack must be named",
    "sim perch --simulated --video": "tests/sim/test_film.py: off-screen OpenGL is not everywhere",
    "sim world": "tests/sim/test_documented_commands.py: with what is typed beside it",
    "ground calibrate": "tests/ground/test_calibrate.py: a person must confirm",
    "calibrate tendons": "tests/sim/test_calibrate_tendons.py: a person must answer",
    "calibrate tension": "tests/unit/test_servo_tools.py: weights must be hung",
    "jog ": "tests/unit/test_jog.py: a keyboard must be there",
}
"""Beginning of a command, and its group; the longest that fits counts."""


def group(line: str) -> str | None:
    """How the tests run a command; None: nobody has said so yet."""
    fits = [start for start in GROUPS if line.startswith(start)]
    if fits:
        return GROUPS[max(fits, key=len)]
    if line.startswith("sim "):
        return ALONE if "--simulated" in line else BEGIN
    return None


def _commands() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        for language, block in _BLOCK.findall(page.read_text(encoding="utf-8")):
            if language in {"", "console", "sh"}:
                lines = block.replace("\\\n", " ").splitlines()
                found += [(page.name, line[start.end() :]) for line in lines if (start := _PREFIX.match(line))]
    return found


COMMANDS: Final = _commands()
"""Page and words of every command in a block of its own."""


def words_of(line: str) -> list[str]:
    """The words as a shell would have them; what follows a pipe, an `&` or a redirection is not ours."""
    words = shlex.split(line, comments=True)
    ends = [i for i, word in enumerate(words) if word in {"|", ">", "&", "&&", ";", "2>"}]
    return words[: ends[0]] if ends else words


def program(path: Path) -> ModuleType:
    """An example program of the documentation as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module
