"""The film of a simulated flight: drawn where there is OpenGL, and said plainly where something is missing."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from arm_companion.__main__ import main as command_line
from arm_companion.cli.sim import _film
from arm_companion.config import load
from arm_companion.sim import film
from arm_companion.sim.plant import Plant, Pose
from arm_companion.sim.progress import Progress
from arm_companion.sim.world import World

CONFIG = load("sim.toml")


@pytest.fixture(scope="module")
def studio() -> film.Studio:
    try:
        return film.studio()
    except film.NoFilm as why:
        pytest.skip(f"NO FILM WAS DRAWN: {why}")


def poses(count: int) -> list[Pose]:
    """The vehicle rises beside the bar."""
    pose = Plant(CONFIG).pose()
    made = []
    for i in range(count):
        qpos = pose.qpos.copy()
        qpos[:3] = pose.bar + np.array((-0.1, 0.0, 0.1 + 0.02 * i))
        made.append(Pose(qpos, pose.bar))
    return made


def pictures(file: Path, by: film.Studio) -> np.ndarray:
    """The film as ffmpeg reads it back, (pictures, height, width, 3)."""
    words = [by.ffmpeg, "-loglevel", "error", "-i", str(file), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(words, capture_output=True, check=True)
    return np.frombuffer(done.stdout, dtype=np.uint8).reshape(-1, film.HEIGHT, film.WIDTH, 3)


def test_a_film_has_all_pictures_and_shows_what_moves(tmp_path: Path, studio: film.Studio) -> None:
    file = tmp_path / "deep" / "flight.mp4"
    film.make(file, CONFIG, poses(12), studio)
    seen = pictures(file, studio).astype(int)
    assert len(seen) == 12
    assert seen[0].std() > 10.0, "it is no empty picture"
    brown = (seen[..., 0] > seen[..., 2] + 30) & (seen[..., 0] < 180)
    assert brown[0].sum() > 200, "the bar is in it"
    assert np.abs(seen[11] - seen[0]).max() > 60, "and something moves"


def test_the_command_draws_it_and_says_when_that_fails(
    tmp_path: Path, studio: film.Studio, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "flight.gif"
    assert _film(file, CONFIG, poses(3), studio, Progress(sys.stdout).console)
    assert file.read_bytes().startswith(b"GIF8")
    assert "3 pictures" in capsys.readouterr().out
    assert not _film(tmp_path, CONFIG, poses(1), studio, Progress(sys.stdout).console)
    assert "could not be made" in capsys.readouterr().err


def test_what_ffmpeg_cannot_write_is_told(tmp_path: Path, studio: film.Studio) -> None:
    folder = tmp_path / "taken.mp4"
    folder.mkdir()
    with pytest.raises(film.NoFilm, match=r"taken\.mp4 could not be made: .*[Ii]s a directory"):
        film.make(folder, CONFIG, poses(2), studio)
    with pytest.raises(film.NoFilm, match="nothing was flown"):
        film.make(tmp_path / "x.mp4", CONFIG, [], studio)


def test_without_opengl_or_ffmpeg_it_says_so_before_anything_flies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["sim", "perch", "--simulated", "--output", str(tmp_path), "--video", str(tmp_path / "x.mp4")]
    monkeypatch.setattr("shutil.which", lambda _: None)
    with monkeypatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda name: None if name == "imageio_ffmpeg" else object())
        assert command_line(words) == 2
    assert "arm-companion[video]" in capsys.readouterr().err
    monkeypatch.setattr("shutil.which", lambda _: "/usr/bin/false")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("LD_LIBRARY_PATH", "/nowhere")
    monkeypatch.setattr(film, "_RENDER", "arm_companion.sim.no_such_module")
    assert command_line(words) == 2
    told = capsys.readouterr().err
    assert "no off-screen OpenGL" in told
    assert "osmesa: " in told
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["sim", "world", "--video", "x.mp4"], "one flight"),
        (["sim", "perch", "--simulated", "--trials", "2", "--video", "x.mp4"], "one flight"),
        (["sim", "perch", "--video", "x.txt"], "ends with one of"),
        (["sim", "perch", "--video", "x"], "ends with one of"),
    ],
)
def test_what_cannot_be_filmed_is_refused(words: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line(words) == 2
    assert reason in capsys.readouterr().err


def test_the_world_keeps_poses_only_for_a_film() -> None:
    world = World(CONFIG)
    for _ in range(50):
        world._advance()
    assert world.poses == []
    filmed = World(CONFIG)
    filmed.pose_every_s = 1.0 / film.PICTURES_PER_S
    while filmed.plant.time < 0.5:
        filmed._advance()
    assert len(filmed.poses) == pytest.approx(0.5 * film.PICTURES_PER_S, abs=1)
    first = filmed.poses[0].qpos.copy()
    filmed._advance()
    assert (filmed.poses[0].qpos == first).all(), "a pose is a copy"
