"""What the documentation says can be typed: every command is known, with its options, and the harmless ones run."""

import contextlib
import re
import shlex
from pathlib import Path
from typing import NoReturn

import pytest

from arm_companion.__main__ import command_line, main
from arm_companion.cli import document

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").glob("*.md") if p.name != "cli.md")]
_BLOCK = re.compile(r"^```(\S*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_PREFIX = re.compile(r"^(?:\$ )?(?:sudo )?(?:\.venv/bin/|/opt/arm-companion/venv/bin/)?arm-companion (?=[a-z-])")
_HARMLESS = ("config schema", "config explain", "model pose", "model tensions", "model deflect", "model clamp")


def commands() -> list[tuple[str, str]]:
    """Page and words of every command in a block of its own."""
    found = []
    for page in PAGES:
        for language, block in _BLOCK.findall(page.read_text(encoding="utf-8")):
            if language in {"", "console", "sh"}:
                lines = block.replace("\\\n", " ").splitlines()
                found += [(page.name, line[start.end() :]) for line in lines if (start := _PREFIX.match(line))]
    return found


COMMANDS = commands()


def words_of(line: str) -> list[str]:
    """The words as a shell would have them; what follows a pipe, an `&` or a redirection is not ours."""
    words = shlex.split(line, comments=True)
    ends = [i for i, word in enumerate(words) if word in {"|", ">", "&", "&&", ";", "2>"}]
    return words[: ends[0]] if ends else words


def test_there_are_commands() -> None:
    assert len(COMMANDS) > 30
    assert {page for page, _ in COMMANDS} >= {"install.md", "simulation.md", "model.md"}


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{page}: {line[:50]}" for page, line in COMMANDS])
def test_every_command_in_the_documentation_is_understood(page: str, line: str) -> None:
    def refuse(message: str) -> NoReturn:
        pytest.fail(f"{page}: {line}: {message}")

    parser = command_line()
    for sub in document.parsers(parser):
        sub.error = refuse  # type: ignore[method-assign]
    with contextlib.suppress(SystemExit):  # --help and --version end here
        parser.parse_args(words_of(line))


@pytest.mark.parametrize(
    "line", sorted({line for _, line in COMMANDS if line.startswith(_HARMLESS)}), ids=lambda line: line[:50]
)
def test_commands_that_only_compute_run(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = words_of(line)
    if words[0] == "config" and words[1] != "schema":
        words += ["--config", "sim.toml", "--set", "links.ground.url=udpout:127.0.0.1:1"]
    assert main(words) == 0


def test_the_page_of_all_commands_is_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    assert page == document.document(), "python -m arm_companion.cli.document > docs/cli.md"


def test_every_relative_link_leads_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
