"""Ready-made packages of every dependency, as pinned, for both machines: pip resolves them and fetches none.

Markers such as `platform_machine == ...` are judged by the machine that this runs on: pip cannot do otherwise.
"""

import json
import re
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
NEWEST_LIBC = 28  # Debian 10, Raspberry Pi OS from 2021, JetPack 5, Ubuntu 20.04 are all newer
pytestmark = pytest.mark.scenario


def needed(extra: str) -> Iterator[str]:
    """What pip is asked for: the base with one extra."""
    yield from PROJECT["dependencies"]
    for requirement in EXTRAS.get(extra, []):
        own = re.fullmatch(r"arm-companion\[(.*)\]", requirement)
        yield from (r for name in own[1].split(",") for r in needed(name)) if own else [requirement]


def resolve(machine: str, python: str, requirements: list[str]) -> subprocess.CompletedProcess[str]:
    tags = (f"manylinux2014_{machine}", *(f"manylinux_2_{minor}_{machine}" for minor in range(17, NEWEST_LIBC + 1)))
    return subprocess.run(
        [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--quiet", "--dry-run", "--report", "-",
         "--ignore-installed", "--only-binary=:all:", "--target", "none", "--python-version", python,
         "-c", ROOT / "constraints.txt", *(word for tag in tags for word in ("--platform", tag)), *requirements],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def index() -> None:
    """There is a package index."""
    if resolve("x86_64", "3.11", ["h11"]).returncode:
        text = "NO PACKAGE INDEX IS REACHABLE: nobody looked whether every dependency is there for both machines"
        warnings.warn(text, pytest.PytestWarning, stacklevel=1)
        pytest.skip(text)


@pytest.mark.usefixtures("index")
@pytest.mark.filterwarnings("default::pytest.PytestWarning")
@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
@pytest.mark.parametrize("machine", ["aarch64", "x86_64"])
def test_nothing_has_to_be_compiled(machine: str, python: str) -> None:
    everything = resolve(machine, python, sorted({r for extra in ("", *EXTRAS) for r in needed(extra)}))
    if everything.returncode:  # name the extras that are short
        short = {extra: resolve(machine, python, list(needed(extra))) for extra in ("", *EXTRAS)}
        pytest.fail("\n".join(f"{extra or 'base'}: {d.stderr}" for extra, d in short.items() if d.returncode))
    found = [item["download_info"]["url"].rpartition("/")[2] for item in json.loads(everything.stdout)["install"]]
    assert len(found) > 50
    assert all(name.endswith((f"_{machine}.whl", "-none-any.whl")) for name in found), found
    assert any(name.startswith("numpy-") and name.endswith(f"_{machine}.whl") for name in found)


@pytest.mark.usefixtures("index")
def test_a_package_that_is_not_there_would_be_noticed() -> None:
    assert resolve("sparc64", "3.11", ["numpy"]).returncode
