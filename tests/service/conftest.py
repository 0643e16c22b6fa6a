"""A systemd of its own in namespaces of its own: real service management, and nothing of this machine's is touched."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "systemd" / "arm-companion.service"
_SYSTEMD = Path("/lib/systemd/systemd")
_BOOT_S = 20.0

# All that systemd writes to is memory of its own. It sees only the units below /run/units: nothing of the machine's
# own services is started, and no directory is cleaned up.
_BOOT = """
set -e
mount --make-rprivate /
mount -t proc proc /proc
mount -t tmpfs tmpfs /run
mkdir /run/units && cp -r "$1"/. /run/units
shift
for place; do mount -t tmpfs tmpfs "$place"; done
umount -l /sys/fs/cgroup 2> /dev/null || true
mount -t tmpfs tmpfs /sys/fs/cgroup
mount -t cgroup2 cgroup2 /sys/fs/cgroup
exec env -i PATH="$PATH" container=other SYSTEMD_UNIT_PATH=/run/units \
    /lib/systemd/systemd --system --unit=default.target --log-target=console --show-status=0
"""
_TARGET = """
[Unit]
Description=what the tests start
Wants=arm-companion.service
"""
_WRITTEN = ("/var/lib", "/var/log", "/var/cache")
_PRESUMED = ("sysinit.target", "basic.target", "shutdown.target", "network.target", "time-sync.target")  # of any system
# What the shipped unit has otherwise: interpreter and checkout may lie in a home directory, or in /tmp.
_DROP_IN = """
[Service]
ExecStart=
ExecStart={command}
User=root
Group=root
ProtectHome=no
PrivateTmp=no
ConfigurationDirectory=
"""


@dataclass
class Machine:
    """A booted systemd."""

    process: "subprocess.Popen[str]"
    init: int  # its process id here

    def show(self, name: str) -> str:
        """A property of the service."""
        words = ["nsenter", "--target", str(self.init), "--mount", "--pid"]
        done = subprocess.run(
            [*words, "systemctl", "show", "--value", "--property", name, "arm-companion"],
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout.strip()

    def until(self, happened: Callable[[], object], seconds: float = 30.0) -> None:
        """Wait for something.

        Raises:
            AssertionError: it did not happen in time.
        """
        end = time.monotonic() + seconds
        while not happened():
            assert time.monotonic() < end, f"not within {seconds:g} s: {self.state()}"
            time.sleep(0.1)

    def state(self) -> str:
        """Everything that helps to see what went wrong."""
        names = ("ActiveState", "SubState", "Result", "NRestarts", "MainPID", "ExecMainStatus")
        return ", ".join(f"{name}={self.show(name)}" for name in names)

    def daemon(self) -> int:
        """The daemon's process id here; its own namespace counts from one."""
        inner = self.show("MainPID")
        for status in Path("/proc").glob("[0-9]*/status"):
            with contextlib.suppress(OSError):
                ids = next(line for line in status.read_text().splitlines() if line.startswith("NSpid:")).split()[1:]
                if len(ids) == 2 and ids[1] == inner and inner != "0" and _descends(int(ids[0]), self.init):
                    return int(ids[0])
        return 0


def _descends(pid: int, ancestor: int) -> bool:
    while pid > 1:
        if pid == ancestor:
            return True
        pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return False


def _obstacle() -> str:
    """Why no systemd can be booted here; empty where it can."""
    if os.geteuid() != 0:
        return "needs root for namespaces"
    missing = [tool for tool in ("unshare", "nsenter", "mount", "systemctl") if shutil.which(tool) is None]
    if missing or not _SYSTEMD.exists():
        return f"needs systemd and util-linux ({', '.join(missing) or _SYSTEMD})"
    mounts = "mount -t tmpfs tmpfs /sys/fs/cgroup && mount -t cgroup2 cgroup2 /sys/fs/cgroup"
    words = ["unshare", "--mount", "--pid", "--fork", "--cgroup", "sh", "-c", mounts]
    tried = subprocess.run(words, capture_output=True, text=True, check=False)
    return "" if tried.returncode == 0 else f"no namespaces here: {tried.stderr.strip()}"


@pytest.fixture
def boot(tmp_path: Path) -> Iterator[Callable[[str], Machine]]:
    """Boots a systemd whose only service is the shipped unit, with other words for the daemon."""
    if (obstacle := _obstacle()) != "":
        pytest.skip(f"the unit was not run under systemd: {obstacle}")
    machines: list[Machine] = []

    def start(words: str) -> Machine:
        units = tmp_path / "units"
        (units / "arm-companion.service.d").mkdir(parents=True)
        shutil.copy(UNIT, units)
        (units / "default.target").write_text(_TARGET)
        for name in _PRESUMED:
            (units / name).write_text("[Unit]\nDefaultDependencies=no\n")
        needed = (str(ROOT), sys.prefix, sys.base_prefix)
        hidden = [place for place in _WRITTEN if not any(path.startswith(f"{place}/") for path in needed)]
        command = f"{sys.executable} -m arm_companion {words}"
        drop_in = _DROP_IN.format(command=command) + f"WorkingDirectory={ROOT}\n"
        (units / "arm-companion.service.d" / "test.conf").write_text(drop_in)
        process = subprocess.Popen(
            ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--cgroup", "--ipc", "--uts", "sh", "-c", _BOOT,
             "sh", str(units), *hidden],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
        )  # fmt: skip
        end = time.monotonic() + _BOOT_S
        while True:
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            if children:
                machine = Machine(process, int(children[0]))
                if machine.show("LoadState") == "loaded":
                    break
            assert time.monotonic() < end, "systemd does not come up"
            time.sleep(0.1)
        machines.append(machine)
        return machine

    yield start
    for machine in machines:
        with contextlib.suppress(ProcessLookupError):
            os.kill(machine.init, signal.SIGKILL)  # the first of its namespace takes all others with it
        machine.process.wait(10.0)
