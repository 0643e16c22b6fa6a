"""`arm-companion doctor`: what stands in the way of a flight, why it matters, and what to do."""

import argparse
import asyncio
import contextlib
import ctypes
import ctypes.util
import json
import os
import pwd
import sys
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Final

from arm_companion import __version__
from arm_companion.arm import compiled
from arm_companion.cli.common import add_config_arguments, load_from
from arm_companion.clock import Clock, run_real_time, unix_now
from arm_companion.config.layers import SYSTEM_FILE
from arm_companion.config.schema import Config
from arm_companion.doctor import arm_checks, config_checks, machine_checks, report, vehicle_checks
from arm_companion.doctor.check import Finding, Level, examine
from arm_companion.doctor.listening import listen_to_servos, listen_to_vehicle
from arm_companion.doctor.subject import Machine, ServosSeen, Subject, VehicleSeen
from arm_companion.drivers.settings import with_kept_changes
from arm_companion.errors import ConfigError
from arm_companion.transport.base import Opener
from arm_companion.transport.urls import open_bus, open_url

CHECKS: Final = (*config_checks.CHECKS, *vehicle_checks.CHECKS, *arm_checks.CHECKS, *machine_checks.CHECKS)
_CODES: Final = {Level.FAIL: 2, Level.WARN: 1}
_USER: Final = "arm-companion"
_SERVICE: Final = {
    "NUMBA_CACHE_DIR": Path("/var/cache/arm-companion"),
    "STATE_DIRECTORY": Path("/var/lib/arm-companion"),
}
"""Variables that the unit, or systemd for it, sets: where mechanics, changed parameters and time stamps are."""

_TIME_ERROR: Final = 5  # adjtimex: the clock is not synchronised
_TIMEX_BYTES: Final = 1024  # more than struct timex of any machine


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `arm-companion doctor`."""
    parser.epilog = (
        "While the daemon runs, neither the servo bus nor the autopilot's link is touched. "
        "Exit code 0: well; 1: warnings; 2: something fails; 78: the configuration cannot be used."
    )
    add_config_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="write a tar.gz to attach to a bug report, with secrets left out"
    )
    parser.add_argument(
        "--patience",
        type=_patience,
        default=5.0,
        metavar="S",
        help="how long to wait for the autopilot's first heartbeat (default: 5)",
    )
    parser.add_argument("--offline", action="store_true", help="open neither the autopilot's link nor the servo bus")


def run(arguments: argparse.Namespace) -> int:
    """Look at everything; the exit code is that of the gravest finding."""
    with eyes_of_the_service(arguments.config):
        subject = look(arguments, machine())
        findings = examine(CHECKS, subject)
    if arguments.json:
        print(json.dumps(_summary(findings), indent=2))
    else:
        print(_table(findings), end="")
    if arguments.report is not None and not _write_report(arguments, findings, subject):
        return 2
    if subject.config is None:
        return ConfigError.exit_code
    return _CODES.get(max(finding.level for finding in findings), 0)


def look(arguments: argparse.Namespace, computer: Machine) -> Subject:
    """All that the checks see."""
    as_the_service()
    try:
        config = with_kept_changes(load_from(arguments))
    except ConfigError as error:
        return Subject(computer, config_error=str(error))
    daemons = tuple(computer.daemons())
    if daemons or arguments.offline:
        why = f"the daemon runs (process {daemons[0]}) and has it" if daemons else "not opened: --offline"
        mend = "; its own view: journalctl -u arm-companion, or `arm-companion ground status`" if daemons else ""
        return Subject(computer, config, vehicle=why + mend, servos=why + mend, daemons=daemons)
    vehicle, servos = run_real_time(_listen(config, arguments.patience))
    return Subject(computer, config, vehicle=vehicle, servos=servos)


async def _listen(config: Config, patience_s: float) -> tuple[VehicleSeen | str, ServosSeen | str]:
    """Both at once; what stops one of them is its finding, and does not stop the other."""
    vehicle, servos = await asyncio.gather(_vehicle(config, patience_s), _servos(config), return_exceptions=True)
    return (
        VehicleSeen(error=_words(vehicle)) if isinstance(vehicle, BaseException) else vehicle,
        ServosSeen(error=_words(servos)) if isinstance(servos, BaseException) else servos,
    )


async def _vehicle(config: Config, patience_s: float) -> VehicleSeen | str:
    urls = [link.url for link in config.links.values() if link.role == "autopilot"]
    if not urls:
        return "no link has the role autopilot"
    opener: Opener = open_url(urls[0])
    clock = Clock(asyncio.get_running_loop(), unix_now())
    return await listen_to_vehicle(config, opener, clock, patience_s)


async def _servos(config: Config) -> ServosSeen:
    return await listen_to_servos(config, open_bus(config.servos.port, config.servos.baud))


def _words(error: BaseException) -> str:
    return "; ".join(map(_words, error.exceptions)) if isinstance(error, BaseExceptionGroup) else str(error)


def machine() -> Machine:
    """This computer."""
    return Machine(
        unix_s=unix_now(),
        synchronised=_synchronised(),
        free_bytes=machine_checks.free_bytes,
        version=_version,
        mechanics=_mechanics,
    )


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@contextlib.contextmanager
def eyes_of_the_service(file: str) -> Iterator[None]:
    """Root, who may do everything, looks at the service's configuration with the rights of the service's user."""
    try:
        user = pwd.getpwnam(_USER)
    except KeyError:
        user = None
    if user is None or os.geteuid() != 0 or Path(file) != SYSTEM_FILE:
        yield
        return
    group, groups = os.getegid(), os.getgroups()
    os.setgroups(os.getgrouplist(user.pw_name, user.pw_gid))
    os.setegid(user.pw_gid)
    os.seteuid(user.pw_uid)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(group)
        os.setgroups(groups)


def as_the_service() -> None:
    """Look where the service looks, where it is installed, unless the environment names another place."""
    for name, directory in _SERVICE.items():
        if directory.is_dir():
            os.environ.setdefault(name, str(directory))


def _mechanics() -> str:
    return compiled.load(compiling=False)


def _synchronised() -> bool | None:
    """What the kernel knows of a time service (adjtimex that only asks)."""
    try:
        libc = ctypes.CDLL(ctypes.util.find_library("c"))
        state = libc.adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != _TIME_ERROR


def _write_report(arguments: argparse.Namespace, findings: Sequence[Finding], subject: Subject) -> bool:
    try:
        files = report.contents(findings, arguments.config, arguments.settings, subject.config)
        report.write(arguments.report, files, subject.machine.unix_s)
    except OSError as error:
        print(f"arm-companion doctor: {arguments.report}: {error.strerror}", file=sys.stderr)
        return False
    print(f"{arguments.report}: written; look through it before you send it", file=sys.stderr)
    return True


def _summary(findings: Sequence[Finding]) -> dict[str, object]:
    worst = max((finding.level for finding in findings), default=Level.SKIPPED)
    return {
        "version": __version__,
        "verdict": max(worst, Level.OK).name.lower(),
        "checks": [finding.as_json() for finding in findings],
    }


def _table(findings: Sequence[Finding]) -> str:
    width = max(len(finding.check) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{finding.level.name.lower():7}  {finding.check:{width}}  {finding.found}")
        if finding.level >= Level.WARN:
            lines.append(f"{'':7}  {'':{width}}  why: {finding.why}")
        if finding.mend:
            lines.append(f"{'':7}  {'':{width}}  do:  {finding.mend}")
    counts = {level: sum(finding.level is level for finding in findings) for level in Level}
    lines.append(", ".join(f"{counts[level]} {level.name.lower()}" for level in reversed(Level)))
    return "\n".join(lines) + "\n"


def _patience(text: str) -> float:
    value = float(text)
    if not 0.1 <= value <= 120.0:
        raise argparse.ArgumentTypeError("0.1 to 120 s")
    return value
