"""The Debian package, built and installed: in an overlay of this machine's own files, which stay as they are.

The one for another machine is taken apart.
"""

import os
import platform
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "systemd" / "deb.sh"
pytestmark = pytest.mark.scenario
_X86_64, _AARCH64 = 62, 183  # e_machine of an ELF file

# A chroot over everything that is here: what dpkg writes goes into memory.
_INSIDE = """
set -e
mount --make-rprivate /
mount -t tmpfs tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
mount -t tmpfs tmpfs /mnt/root/run
mount -t proc proc /mnt/root/proc
mount --rbind /dev /mnt/root/dev
cp "$1" /mnt/root/run/package.deb
exec chroot /mnt/root sh -ec "$2"
"""
_LIFE = """
cd /
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
dpkg --force-depends --install /run/package.deb
dpkg-query --show --showformat '${db:Status-Status}\\n' arm-companion
echo user: $(id -un arm-companion) in $(id -Gn arm-companion)
systemctl is-enabled arm-companion.service
arm-companion --version
arm-companion config check
arm-companion doctor --patience 0.1 | tail -n 1
if systemd-analyze verify arm-companion.service; then echo verified; fi
echo '# mine' >> /etc/arm-companion/config.toml
dpkg --install /run/package.deb
tail -n 1 /etc/arm-companion/config.toml
dpkg --remove arm-companion
test ! -e /opt/arm-companion
test ! -e /usr/bin/arm-companion
test -e /etc/arm-companion/config.toml
dpkg --purge arm-companion
test ! -e /etc/arm-companion
echo gone
"""


def build(folder: Path, *words: str) -> Path:
    """A package of this checkout."""
    if shutil.which("dpkg-deb") is None or not Path("/usr/bin/python3").exists():
        pytest.skip("no Debian package was built: needs dpkg-deb and Debian's python3")
    if subprocess.run(["/usr/bin/python3", "-c", "import ensurepip"], capture_output=True, check=False).returncode:
        pytest.skip("no Debian package was built: needs python3-venv")
    done = subprocess.run([SCRIPT, "--output", folder, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.strip())


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of this checkout for this machine."""
    return build(tmp_path_factory.mktemp("deb"))


def test_it_holds_what_the_service_needs_and_nothing_else(package: Path) -> None:
    listed = subprocess.run(["dpkg-deb", "--contents", package], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 5) for line in listed.splitlines()]
    names = {row[5].partition(" -> ")[0].removeprefix(".") for row in rows}
    assert {
        "/etc/arm-companion/config.toml",
        "/lib/systemd/system/arm-companion.service",
        "/lib/udev/rules.d/60-arm-companion.rules",
        "/usr/lib/sysusers.d/arm-companion.conf",
        "/usr/bin/arm-companion",
    } <= names
    strays = [
        name
        for name in names
        if not name.startswith(("/opt/arm-companion/", "/etc/arm-companion/", "/usr/share/doc/arm-companion/"))
        and not name.endswith("/")
    ]
    assert len(strays) == 4, strays
    assert {row[1] for row in rows} == {"root/root"}


def test_it_is_installed_upgraded_removed_and_purged(package: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("the package was not installed: needs root")
    words = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", _INSIDE, "sh", str(package), _LIFE]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if "mount:" in done.stderr:
        pytest.skip(f"the package was not installed: no overlay here: {done.stderr.strip()}")
    assert done.returncode == 0, done.stdout + done.stderr
    out = done.stdout
    for words_told in (
        "user: arm-companion in arm-companion dialout",
        "enabled",
        "arm-companion 0.1.0",
        "config.toml: usable",
        "verified",
        "# mine",
    ):
        assert words_told in out, out + done.stderr
    assert out.strip().endswith("gone")


_FOREIGN = {"x86_64": ("arm64", _AARCH64), "aarch64": ("amd64", _X86_64)}


@pytest.mark.skipif(platform.machine() not in _FOREIGN, reason="neither x86-64 nor 64-bit Arm")
def test_a_package_for_the_other_machine_holds_its_programs_and_needs_no_compiler(tmp_path: Path) -> None:
    architecture, machine = _FOREIGN[platform.machine()]
    package = build(tmp_path, "--arch", architecture)
    field = subprocess.run(["dpkg-deb", "--field", package, "Architecture"], capture_output=True, text=True, check=True)
    assert field.stdout.strip() == architecture
    assert package.name.endswith(f"_{architecture}.deb")
    root = tmp_path / "root"
    subprocess.run(["dpkg-deb", "--raw-extract", package, root], check=True)
    venv = root / "opt/arm-companion/venv"
    binaries = {path: path.read_bytes()[:20] for path in venv.rglob("*") if path.is_file() and not path.is_symlink()}
    machines = {
        path.name: int.from_bytes(head[18:20], "little") for path, head in binaries.items() if head[:4] == b"\x7fELF"
    }
    assert len(machines) > 10
    assert set(machines.values()) == {machine}, machines
    for name in ("numpy", "fastcrc", "mcap", "orjson", "aiomqtt", "arm_companion/protocol/dialect/generated.py"):
        assert list(venv.glob(f"lib/python3.*/site-packages/{name}")), name
    command = venv / "bin/arm-companion"
    assert command.read_text().startswith("#!/opt/arm-companion/venv/bin/python\n")
    assert command.stat().st_mode & 0o777 == 0o755
    assert (root / "usr/bin/arm-companion").readlink() == Path("/opt/arm-companion/venv/bin/arm-companion")
    for script in ("postinst", "prerm"):  # nothing is fetched, compiled or run there but what Debian has
        words = (root / "DEBIAN" / script).read_text()
        assert not {word for word in ("pip", "cc ", "/opt/", "python") if word in words}


def test_help_and_wrong_use() -> None:
    assert "usage: deb.sh" in subprocess.run([SCRIPT, "--help"], capture_output=True, text=True, check=True).stdout
    assert subprocess.run([SCRIPT, "--arch", "sparc"], capture_output=True, check=False).returncode == 2
    done = subprocess.run([SCRIPT, "--nonsense"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "--nonsense" in done.stderr
