"""Compiled mechanics: loaded from numba's cache, never compiled by a program that flies, NumPy where there are none."""

import asyncio
import importlib.util
import logging
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from arm_companion.__main__ import main
from arm_companion.app import Daemon, open_configured
from arm_companion.arm import compiled
from arm_companion.clock import Clock
from arm_companion.config import load
from arm_companion.supervisor import ServiceManager

CONFIG = load("zhao2022.toml", ['links.a.url="udpin:127.0.0.1:24541"', 'links.a.role="autopilot"'])


def load_in_new_process(cache: Path) -> subprocess.CompletedProcess[str]:
    code = "from arm_companion.arm import compiled; print(compiled.load(compiling=False))"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)


def test_an_empty_cache_is_refused_and_nothing_is_compiled(tmp_path: Path) -> None:
    pytest.importorskip("numba")
    begun = time.perf_counter()
    found = load_in_new_process(tmp_path)
    assert found.returncode == 1
    assert "not in numba's cache: `arm-companion model warm` compiles it" in found.stderr
    assert not list(tmp_path.rglob("*.nbc"))
    assert time.perf_counter() - begun < 20  # compiling takes longer


def test_what_is_compiled_stays_in_the_cache_that_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("numba")
    assert main(["model", "warm"]) == 0
    place = Path(capsys.readouterr().out.split(" are in ")[1].split(", after")[0])
    assert list(place.glob("fast_newton.newton-*.nbc"))
    assert compiled.load(compiling=False) == str(place)


def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "numba" else find(name))


def test_without_numba_warm_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without_numba(monkeypatch)
    assert main(["model", "warm"]) == 2
    assert "extra 'fast'" in capsys.readouterr().err


def prepared() -> Daemon:
    async def prepare() -> Daemon:
        clock = Clock(asyncio.get_running_loop(), 0.0)
        daemon = Daemon(CONFIG, open_configured(CONFIG), clock, ServiceManager(""), compiled_model=True)
        await daemon._prepare_model()
        return daemon

    return asyncio.run(prepare())


def test_the_daemon_takes_compiled_mechanics_from_the_cache(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("numba")
    compiled.load(compiling=True)
    with caplog.at_level(logging.INFO):
        daemon = prepared()
    assert type(daemon._parameters.model._rod(0.25, 0)).__name__ == "FastRod"  # type: ignore[attr-defined]
    assert "mechanics compiled by numba" in caplog.text


def test_the_daemon_flies_on_numpy_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    without_numba(monkeypatch)
    with caplog.at_level(logging.INFO):
        daemon = prepared()
    assert type(daemon._parameters.model._rod(0.25, 0)).__name__ == "Rod"  # type: ignore[attr-defined]
    assert "mechanics on NumPy: numba is not installed" in caplog.text
