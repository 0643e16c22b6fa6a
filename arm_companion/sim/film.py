"""A film of a simulated flight: poses are kept while it flies, and drawn off-screen when it is over.

Drawing by a processor takes longer than the flight, so that it must not happen meanwhile.
"""

import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from arm_companion.config.schema import Config
from arm_companion.errors import ArmError
from arm_companion.sim.mjcf import model_xml
from arm_companion.sim.plant import Pose

WIDTH: Final = 640
HEIGHT: Final = 360
PICTURES_PER_S: Final = 15

_RENDER: Final = "arm_companion.sim.film_render"
_BACKENDS: Final = ("egl", "osmesa")
_TRY_S: Final = 60.0
_HINT: Final = "Debian: apt-get install libegl1 libgl1-mesa-dri, or libosmesa6"


class NoFilm(ArmError):
    """What a film needs is not there, or has failed; the message says what."""


@dataclass(frozen=True, slots=True)
class Studio:
    """What a film is made with.

    Attributes:
        backend: of OpenGL, as MUJOCO_GL names it.
        ffmpeg: the program.
    """

    backend: str
    ffmpeg: str


def studio() -> Studio:
    """Find what is needed; takes some seconds, since OpenGL is really tried.

    Raises:
        NoFilm: it is not there.
    """
    ffmpeg = _ffmpeg()
    tried = []
    for backend in (os.environ["MUJOCO_GL"],) if os.environ.get("MUJOCO_GL") else _BACKENDS:
        try:
            done = _run([], backend, _TRY_S)
        except subprocess.TimeoutExpired:
            tried.append(f"{backend}: no answer in {_TRY_S:g} s")
            continue
        if done.returncode == 0:
            return Studio(backend, ffmpeg)
        tried.append(f"{backend}: {_last_line(done.stderr)}")
    raise NoFilm(f"there is no off-screen OpenGL here ({'; '.join(tried)}). {_HINT}")


def make(path: Path, config: Config, poses: Sequence[Pose], by: Studio) -> None:
    """Draw a flight.

    Args:
        path: of the film; its ending says which kind, such as .mp4.
        config: of the world that was flown in.
        poses: one a picture.
        by: what it is made with.

    Raises:
        NoFilm: it failed.
    """
    if not poses:
        raise NoFilm("nothing was flown that could be drawn")
    path.parent.mkdir(parents=True, exist_ok=True)
    encode = [
        by.ffmpeg, "-y", "-loglevel", "error",
        "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", str(PICTURES_PER_S), "-i", "-",
        "-pix_fmt", "yuv420p", str(path),
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "poses.npz"
        qpos, bar = np.array([pose.qpos for pose in poses]), np.array([pose.bar for pose in poses])
        np.savez(file, xml=np.array(model_xml(config)), qpos=qpos, bar=bar)
        done = _run([str(file), *encode], by.backend, None)
    if done.returncode != 0:
        raise NoFilm(f"the film {path} could not be made: {_last_line(done.stderr)}")


def _ffmpeg() -> str:
    """The machine's, else that of the package.

    Raises:
        NoFilm: there is none.
    """
    if found := shutil.which("ffmpeg"):
        return found
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        try:
            return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
        except RuntimeError:  # a package without its program
            pass
    raise NoFilm("there is no ffmpeg: apt-get install ffmpeg, or pip install 'arm-companion[video]'")


def _run(words: list[str], backend: str, timeout: float | None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603 - our own module
        [sys.executable, "-m", _RENDER, *words],
        env={**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        timeout=timeout,
        check=False,
    )


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1][:200] if lines else "it ended without a word"
