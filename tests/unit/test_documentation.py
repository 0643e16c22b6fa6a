"""What the documentation says can be typed: every command is known, with its options, and the harmless ones run."""

import contextlib
import re
from pathlib import Path
from typing import NoReturn

import pytest

from arm_companion.__main__ import command_line, main
from arm_companion.cli import document
from tests.documentation import COMMANDS, HARMLESS, PAGES, ROOT, group, words_of


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


def test_of_every_command_it_is_said_who_runs_it() -> None:
    assert {line for _, line in COMMANDS if group(line) is None} == set()
    for _, line in COMMANDS:
        name, _, because = str(group(line)).partition(": ")
        assert not because or (ROOT / name).exists(), name


@pytest.mark.parametrize(
    "line", sorted({line for _, line in COMMANDS if group(line) == HARMLESS}), ids=lambda line: line[:50]
)
def test_commands_that_only_compute_run(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = words_of(line)
    if words[0] == "config" and words[1] != "schema":
        words += ["--config", "sim.toml", "--set", "links.ground.url=udpout:127.0.0.1:1"]
    with contextlib.suppress(SystemExit):  # --version
        assert main(words) == 0


def test_the_page_of_all_commands_is_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    assert page == document.document(), "python -m arm_companion.cli.document > docs/cli.md"


def test_every_test_that_a_page_names_is_there() -> None:
    named = {path for page in PAGES for path in re.findall(r"tests/[\w/]+\.py", page.read_text(encoding="utf-8"))}
    assert len(named) > 15
    assert {path for path in named if not (ROOT / path).exists()} == set()


def test_every_relative_link_leads_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
