"""systemd/install.sh in a scratch root: what it lays down and takes away; a second run changes nothing."""

import os
import re
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "systemd" / "install.sh"
UNIT = "etc/systemd/system/arm-companion.service"
CONFIG = "etc/arm-companion/config.toml"
STATE = "var/lib/arm-companion"


def call(*words: str | Path, code: int = 0, **environment: str) -> str:
    done = subprocess.run(
        [SCRIPT, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        stdin=subprocess.DEVNULL,
        env={**os.environ, **environment},
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def install(root: Path, *words: str) -> str:
    return call("--root", root, "--no-venv", *words)


def tree(root: Path) -> dict[str, object]:
    """Everything below, with content, mode, owner and time."""
    found: dict[str, object] = {}
    for path in sorted(root.rglob("*")):
        stat = path.lstat()
        held: object = path.readlink() if path.is_symlink() else path.read_bytes() if path.is_file() else None
        found[str(path.relative_to(root))] = (held, stat.st_mode, stat.st_uid, stat.st_mtime_ns)
    return found


def test_it_lays_down_all_that_the_service_needs(tmp_path: Path) -> None:
    install(tmp_path)
    assert (tmp_path / UNIT).read_bytes() == (SCRIPT.parent / "arm-companion.service").read_bytes()
    assert (tmp_path / "etc/udev/rules.d/99-arm-companion.rules").is_file()
    assert (tmp_path / "etc/sysusers.d/arm-companion.conf").is_file()
    assert (tmp_path / CONFIG).is_file()
    wanted = tmp_path / "etc/systemd/system/multi-user.target.wants/arm-companion.service"
    assert str(wanted.readlink()) == f"/{UNIT}"
    for directory in (STATE, "var/log/arm-companion", "var/cache/arm-companion"):
        assert (tmp_path / directory).stat().st_mode & 0o777 == 0o750


@pytest.mark.skipif(os.geteuid() != 0, reason="a user is made by root alone")
def test_the_user_is_in_the_group_of_serial_ports_and_owns_its_directories(tmp_path: Path) -> None:
    install(tmp_path)
    if not (tmp_path / "etc/passwd").exists():
        pytest.skip("systemd-sysusers is not installed")
    users = dict(line.split(":", 1) for line in (tmp_path / "etc/passwd").read_text().splitlines())
    groups = dict(line.split(":", 1) for line in (tmp_path / "etc/group").read_text().splitlines())
    assert groups["dialout"].endswith("arm-companion")
    assert (tmp_path / STATE).stat().st_uid == int(users["arm-companion"].split(":")[1])


def test_the_configuration_that_it_lays_down_can_be_used(tmp_path: Path) -> None:
    from arm_companion.app import open_configured
    from arm_companion.config import load

    install(tmp_path)
    config = load(tmp_path / CONFIG)
    open_configured(config)
    config.check_servos()
    assert [link.role for link in config.links.values()] == ["autopilot"]


@pytest.mark.parametrize("script", ["install.sh", "deb.sh"])
def test_what_is_installed_by_default_suffices_for_the_configuration_that_comes_with_it(script: str) -> None:
    from arm_companion.config import load

    config = load(SCRIPT.parent / "config.toml")
    help_text = subprocess.run([SCRIPT.parent / script, "--help"], capture_output=True, text=True, check=True).stdout
    (extras,) = re.findall(r"--extras LIST .*\(default: (.*)\)", help_text)
    assert ("record" in extras.split(",")) or not (config.record.directory or config.record.file)
    assert ("mqtt" in extras.split(",")) or not config.mqtt.host


@pytest.mark.parametrize("again", ["install", "upgrade"])
def test_a_second_run_changes_nothing(tmp_path: Path, again: str) -> None:
    install(tmp_path)
    before = tree(tmp_path)
    text = install(tmp_path, again)
    assert tree(tmp_path) == before
    assert not {"write", "make", "enable"} & {line.split()[0] for line in text.splitlines()}


def test_a_configuration_that_was_edited_is_kept_and_an_old_unit_replaced(tmp_path: Path) -> None:
    install(tmp_path)
    (tmp_path / CONFIG).write_text("[vehicle]\nmass_kg = 2.5\n")
    (tmp_path / UNIT).write_text("[Unit]\nDescription=an older one\n")
    install(tmp_path, "upgrade")
    assert "2.5" in (tmp_path / CONFIG).read_text()
    assert "older" not in (tmp_path / UNIT).read_text()


@pytest.mark.parametrize("action", ["install", "upgrade", "uninstall"])
def test_a_dry_run_does_nothing_and_says_what_it_would(tmp_path: Path, action: str) -> None:
    if action == "uninstall":
        install(tmp_path)
    before = tree(tmp_path)
    text = call("--root", tmp_path, "--dry-run", action)
    assert tree(tmp_path) == before
    assert "would" in text
    if action != "uninstall":
        assert "-m venv" in text
        assert "pip" in text


def test_an_image_of_another_machine_is_filled_from_ready_made_packages_and_only_below_a_root(tmp_path: Path) -> None:
    text = call("--root", tmp_path, "--dry-run", "--machine", "aarch64")
    assert "-m venv --without-pip" in text
    assert "--only-binary=:all: --platform manylinux*_aarch64" in text
    assert tree(tmp_path) == {}
    assert "--root" in call("--dry-run", "--machine", "aarch64", code=2, DESTDIR="")


def test_uninstalling_leaves_what_is_the_users_and_purging_does_not(tmp_path: Path) -> None:
    install(tmp_path)
    (tmp_path / STATE / "parameters.json").write_text("{}")
    (tmp_path / "opt/arm-companion/venv/bin").mkdir(parents=True)
    install(tmp_path, "uninstall")
    for gone in (UNIT, "etc/udev/rules.d/99-arm-companion.rules", "opt/arm-companion"):
        assert not (tmp_path / gone).exists()
    assert (tmp_path / CONFIG).exists()
    assert (tmp_path / STATE / "parameters.json").exists()
    install(tmp_path, "uninstall")  # nothing left is no failure
    install(tmp_path, "uninstall", "--purge")
    assert not (tmp_path / CONFIG).exists()
    assert not (tmp_path / STATE).exists()
    assert list(tmp_path.rglob("arm-companion*")) == []


def test_destdir_is_a_root_too(tmp_path: Path) -> None:
    call("--no-venv", DESTDIR=str(tmp_path))
    assert (tmp_path / UNIT).is_file()


@pytest.mark.parametrize(
    "words",
    [
        ("--root",),
        ("nonsense",),
        ("--purge", "install"),
        ("--colour", "red"),
        ("--extras",),
        ("--machine", "sparc"),
    ],
)
def test_wrong_use_is_told_with_the_usage(words: tuple[str, ...], tmp_path: Path) -> None:
    assert "usage:" in call(*words, code=2, DESTDIR=str(tmp_path))
    assert tree(tmp_path) == {}


def test_help_is_help(tmp_path: Path) -> None:
    text = call("--help", DESTDIR=str(tmp_path))
    for word in ("install", "upgrade", "uninstall", "--root", "--dry-run", "--purge", "--extras"):
        assert word in text


def test_a_source_that_is_none_and_a_python_that_is_too_old_are_refused(tmp_path: Path) -> None:
    root = tmp_path / "root"
    assert "no checkout" in call("--root", root, "--source", tmp_path, code=1)
    old = tmp_path / "python"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    assert "3.11" in call("--root", root, "--python", old, code=1)


@pytest.mark.parametrize("name", ["my images", "image*"])
def test_a_root_that_would_fall_apart_is_refused(tmp_path: Path, name: str) -> None:
    """`uninstall --purge` below "my images" removed "my"."""
    (tmp_path / "my").mkdir()
    for action in (["--no-venv"], ["uninstall", "--purge"]):
        assert "without blanks" in call(*action, "--root", tmp_path / name, code=2)
    assert (tmp_path / "my").is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["my"]
