"""`doctor`: each check on a machine, vehicle and servos of the test's own making; the command; the report's secrets."""

import argparse
import dataclasses
import importlib.util
import json
import os
import socket
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from arm_companion.__main__ import main
from arm_companion.arm.compiled import NotCompiled
from arm_companion.cli import doctor as command
from arm_companion.config import Config
from arm_companion.config.schema import (
    CalibrationConfig,
    KeepOutConfig,
    LimitsConfig,
    LinkConfig,
    MqttConfig,
    RecordConfig,
)
from arm_companion.doctor import report
from arm_companion.doctor.check import Check, Finding, Level, Outcome, examine, ok, warn
from arm_companion.doctor.redaction import HIDDEN, redact
from arm_companion.doctor.subject import Machine, ServosSeen, Subject, VehicleSeen, is_daemon
from arm_companion.drivers import calibration_files
from arm_companion.drivers.servo_health import ServoState
from tests.unit.test_calibration import NOW, calibration

AUTOPILOT = LinkConfig("udpin:127.0.0.1:14540", "autopilot")
CONFIG = dataclasses.replace(Config(), links={"autopilot": AUTOPILOT})
GOOD = {"MAV_1_FORWARD": 1.0, "COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 5.0}
RATES = {"ATTITUDE_QUATERNION": (100.0, 98.0), "LOCAL_POSITION_NED": (100.0, 97.0)}
VEHICLE = VehicleSeen(
    received_bytes=9000, frames=500, system_id=1, parameters=GOOD, rates_hz=RATES, clock_error_s=0.001
)
SERVO = ServoState(
    1, 2048, 0.0, 0.0, 12.0, 35.0, 0, torque=False, tripped=False, turns_lost=False, ready=True, silent=False, age_s=0.0
)  # fmt: skip
SERVOS = tuple(dataclasses.replace(SERVO, id=i) for i in (1, 2, 3, 4))
SEEN = ServosSeen(servos=SERVOS, firmware=(46,) * 4, answers=200, latency_s=0.0005)


def machine(root: Path, **changes: Any) -> Machine:
    versions = {"arm-companion": "0.1.0", "fastcrc": "0.5.0", "numpy": "2.4.6", "pyserial": "3.5"}
    plain = Machine(NOW, True, lambda _: 10**12, versions.get, lambda: "/cache", root, {})
    return dataclasses.replace(plain, **changes)


def fenced(degrees: float) -> LimitsConfig:
    return LimitsConfig(keep_out=KeepOutConfig(half_angle_deg=degrees))


@pytest.fixture
def subject(tmp_path: Path) -> Subject:
    """Where nothing is wrong."""
    config = dataclasses.replace(
        CONFIG,
        record=RecordConfig(directory=str(tmp_path)),
        calibration=CalibrationConfig(directory=str(tmp_path)),
        vehicle=dataclasses.replace(CONFIG.vehicle, commanders=(255,)),
        limits=fenced(60.0),
    )
    calibration_files.save(tmp_path / calibration_files.TENDONS, calibration())
    lay(tmp_path, "sys/devices/system/cpu/cpufreq/policy0/scaling_governor", "performance\n")
    lay(tmp_path, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "1\n")
    return Subject(machine(tmp_path), config, vehicle=VEHICLE, servos=SEEN)


def lay(root: Path, path: str, text: str) -> None:
    (root / path).parent.mkdir(parents=True, exist_ok=True)
    (root / path).write_text(text, encoding="utf-8")


def found(subject: Subject, name: str) -> Finding:
    (check,) = (check for check in command.CHECKS if check.name == name)
    (finding,) = examine([check], subject)
    return finding


def with_(subject: Subject, **parts: Any) -> Subject:
    """Another vehicle, servos, machine or configuration, with fields changed."""
    changed = {
        name: dataclasses.replace(getattr(subject, name), **value) if isinstance(value, dict) else value
        for name, value in parts.items()
    }
    return dataclasses.replace(subject, **changed)


def servo(**changes: Any) -> dict[str, Any]:
    return {"servos": (dataclasses.replace(SERVO, **changes), *SERVOS[1:])}


def test_where_nothing_is_wrong_every_check_is_well_and_has_its_reason(subject: Subject) -> None:
    findings = examine(command.CHECKS, subject)
    assert [(f.check, f.level) for f in findings if f.level is not Level.OK] == []
    assert len(findings) == len(command.CHECKS) == len({f.check for f in findings})
    assert all(f.why and f.found and not f.mend for f in findings)


@pytest.mark.parametrize(
    ("check", "change", "level", "words"),
    [
        ("link", {"vehicle": {"error": "cannot open /dev/ttyX"}}, Level.FAIL, "cannot open"),
        ("link", {"vehicle": VehicleSeen()}, Level.FAIL, "nothing comes"),
        ("link", {"vehicle": VehicleSeen(received_bytes=700)}, Level.FAIL, "none of them MAVLink"),
        ("link", {"vehicle": VehicleSeen(received_bytes=70, frames=9)}, Level.FAIL, "no autopilot's heartbeat"),
        ("link", {"vehicle": VehicleSeen(received_bytes=70, refused=9)}, Level.FAIL, "signature"),
        ("link", {"vehicle": {"fits": False}}, Level.FAIL, "no px4"),
        ("link", {"vehicle": {"lost": 100}}, Level.WARN, "100 of 600"),
        ("link", {"vehicle": {"rates_hz": {"LOCAL_POSITION_NED": (100.0, 9.0)}}}, Level.WARN, "comes at 9 Hz"),
        ("link", {"vehicle": "the daemon runs"}, Level.SKIPPED, "the daemon runs"),
        ("autopilot parameters", {"vehicle": {"parameters": {}}}, Level.WARN, "no parameter request"),
        ("autopilot parameters", {"vehicle": {"parameters": {**GOOD, "COM_OBL_RC_ACT": 0.0}}}, Level.WARN, "is 0"),
        ("autopilot parameters", {"vehicle": {"parameters": {**GOOD, "MAV_1_FORWARD": 0.0}}}, Level.OK, "FORWARD"),
        ("forwarding", {"vehicle": {"parameters": {**GOOD, "MAV_1_FORWARD": 0.0}}}, Level.WARN, "does not forward"),
        ("forwarding", {"vehicle": {"stations": (255,), "parameters": {}}}, Level.OK, "255 is heard"),
        ("forwarding", {"vehicle": {"parameters": {"COM_OF_LOSS_T": 1.0}}}, Level.SKIPPED, "no such parameter"),
        ("autopilot clock", {"vehicle": {"clock_error_s": float("inf")}}, Level.WARN, "no TIMESYNC"),
        ("autopilot clock", {"vehicle": {"clock_error_s": 0.2}}, Level.WARN, "200 ms"),
        ("servos", {"servos": {"error": "another program holds its lock"}}, Level.FAIL, "another program"),
        ("servos", {"servos": servo(silent=True)}, Level.FAIL, "servo 1 is silent"),
        ("servos", {"servos": servo(error_bits=0x20)}, Level.FAIL, "overload"),
        ("servos", {"servos": servo(temperature=70.0)}, Level.WARN, "70 degC"),
        ("servos", {"servos": {"lost": 40}}, Level.WARN, "40 of 240"),
        ("servos", {"servos": {"latency_s": 0.006}}, Level.WARN, "6.0 ms"),
        ("voltage", {"servos": servo(voltage=8.0)}, Level.FAIL, "8.0 to 12.0 V"),
        ("voltage", {"servos": servo(voltage=9.7)}, Level.WARN, "9.7"),
        ("voltage", {"servos": servo(voltage=15.0)}, Level.FAIL, "15.0 V"),
        ("voltage", {"servos": {"error": "x"}}, Level.SKIPPED, "cannot be opened"),
        ("clock", {"machine": {"unix_s": 1e9}}, Level.FAIL, "never set"),
        ("clock", {"machine": {"unix_s": NOW - 40 * 86_400.0}}, Level.FAIL, "before the calibration"),
        ("clock", {"machine": {"synchronised": False}}, Level.WARN, "no time service"),
        ("calibration", {"machine": {"unix_s": NOW + 200 * 86_400.0}}, Level.WARN, "200 days"),
        ("calibration", {"servos": {"firmware": (46, 47, 46, 46)}}, Level.FAIL, "servo 2 has firmware 47"),
        ("disk", {"machine": {"free_bytes": lambda _: 10**9}}, Level.WARN, "room for 0.8 h"),
        ("disk", {"machine": {"free_bytes": lambda _: 10**6}}, Level.FAIL, "1 MB are free"),
        ("disk", {"config": CONFIG}, Level.WARN, "nothing is kept"),
        ("keep-out cone", {"config": CONFIG}, Level.WARN, "there is no cone"),
        ("keep-out cone", {"config": dataclasses.replace(CONFIG, limits=fenced(88.0))}, Level.FAIL, "inside the cone"),
        ("keep-out cone", {"config": dataclasses.replace(CONFIG, limits=fenced(60.0))}, Level.OK, "1.5 cm away"),
        ("calibration", {"config": CONFIG}, Level.WARN, "there is none"),
        ("versions", {"machine": {"version": {"numpy": "1.20.0", "fastcrc": "1", "pyserial": "3.5"}.get}}, Level.FAIL,
         "numpy 1.20.0 is older than 1.26"),
        ("versions", {"machine": {"version": {"numpy": "2.0"}.get}}, Level.FAIL, "fastcrc is missing"),
        ("access", {"config": dataclasses.replace(CONFIG, links={
            "autopilot": AUTOPILOT, "ground": LinkConfig("udpin:127.0.0.1:1", "ground")})}, Level.WARN,
         "autopilot, ground"),
        # ground stations come through the autopilot's link too, and a key that unsigned frames get around is none
        ("access", {"config": dataclasses.replace(CONFIG, links={"autopilot": AUTOPILOT})}, Level.WARN,
         "link autopilot"),
        ("access", {"config": dataclasses.replace(CONFIG, links={"wifi": LinkConfig(
            "udpin:127.0.0.1:1", "ground", signing_key="/key", unsigned="accept")})}, Level.WARN, "link wifi"),
        ("access", {"config": dataclasses.replace(CONFIG, links={"camera": LinkConfig(
            "udpin:127.0.0.1:1", "peer")})}, Level.OK, "whoever signs"),
        ("configuration", {"config": Config()}, Level.FAIL, "role autopilot"),
        ("configuration", {"config": dataclasses.replace(CONFIG, links={
            "autopilot": LinkConfig("nonsense", "autopilot")})}, Level.FAIL, "nonsense"),
        ("configuration", {"config": dataclasses.replace(CONFIG, links={
            "autopilot": dataclasses.replace(AUTOPILOT, signing_key="/nowhere/key")})}, Level.FAIL, "/nowhere/key"),
        ("configuration", {"config": dataclasses.replace(CONFIG, mqtt=MqttConfig(
            host="x", user_file="/nowhere/user"))}, Level.FAIL, "/nowhere/user"),
        ("configuration", {"config": None, "config_error": "arm.toml: mass_kg = -1"}, Level.FAIL, "mass_kg = -1"),
    ],
)  # fmt: skip
def test_each_trouble_is_found_and_told(
    subject: Subject, check: str, change: dict[str, Any], level: Level, words: str
) -> None:
    finding = found(with_(subject, **change), check)
    assert (finding.level, words in finding.found) == (level, True), finding
    assert bool(finding.mend) == (level > Level.OK), finding


def test_files_of_the_machine_are_judged(subject: Subject, tmp_path: Path) -> None:
    lay(tmp_path, "sys/devices/system/cpu/cpufreq/policy1/scaling_governor", "powersave\n")
    assert found(subject, "cpu governor").level is Level.WARN
    lay(tmp_path, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "16\n")
    assert "16 ms" in found(subject, "latency timer").found
    lay(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "50005\n")
    assert "too low now" in found(subject, "voltage").found
    lay(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "50000\n")
    assert found(subject, "voltage").level is Level.WARN
    (tmp_path / calibration_files.TENDONS).write_text("{", encoding="utf-8")
    assert found(subject, "calibration").level is Level.FAIL


def test_a_machine_without_such_files_skips_what_it_cannot_tell(subject: Subject, tmp_path: Path) -> None:
    bare = with_(subject, machine={"root": tmp_path / "bare"})
    assert found(bare, "cpu governor").level is found(bare, "latency timer").level is Level.SKIPPED


def test_mechanics_that_are_not_compiled_are_a_warning(subject: Subject) -> None:
    def missing() -> str:
        raise NotCompiled("not in numba's cache")

    finding = found(with_(subject, machine={"mechanics": missing}), "compiled mechanics")
    assert (finding.level, "numba's cache" in finding.found) == (Level.WARN, True)
    assert "arm-companion[fast]" in finding.mend


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_directory_that_cannot_be_written_is_found(subject: Subject, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        assert found(subject, "disk").level is Level.FAIL
    finally:
        tmp_path.chmod(0o700)


def test_a_configuration_that_cannot_be_used_leaves_the_machine_to_be_examined(tmp_path: Path) -> None:
    findings = examine(command.CHECKS, Subject(machine(tmp_path), None, "arm.toml: not valid TOML"))
    levels = {f.check: f.level for f in findings}
    assert levels["configuration"] is Level.FAIL
    assert levels["versions"] is levels["clock"] is Level.OK
    assert levels["link"] is levels["servos"] is levels["disk"] is Level.SKIPPED


def test_a_broken_check_never_hides_the_others(subject: Subject) -> None:
    def broken(_: Subject) -> Outcome:
        raise ZeroDivisionError

    def broken_midway(_: Subject) -> Iterator[Outcome]:
        yield ok("so far")
        raise RuntimeError("the sensor is odd")

    findings = examine(
        [Check("a", "x", broken), Check("b", "x", broken_midway), Check("c", "x", lambda _: ok("fine"))], subject
    )
    assert [f.level for f in findings] == [Level.FAIL, Level.FAIL, Level.OK]
    assert "ZeroDivisionError" in findings[0].found
    assert "the sensor is odd" in findings[1].found


def test_the_gravest_outcomes_make_the_finding_and_a_check_of_nothing_is_skipped(subject: Subject) -> None:
    (both, nothing) = examine(
        [Check("a", "x", lambda _: [ok("1"), warn("2", "m"), warn("3", "m")]), Check("b", "x", lambda _: [])], subject
    )
    assert (both.level, both.found, both.mend) == (Level.WARN, "2; 3", "m")
    assert nothing.level is Level.SKIPPED


# the daemon


@pytest.mark.parametrize(
    ("line", "daemon"),
    [
        ("/opt/arm-companion/venv/bin/python /opt/arm-companion/venv/bin/arm-companion run --config x", True),
        ("python -m arm_companion run --config x", True),
        ("python /srv/arm_companion/__main__.py run", True),
        ("arm-companion doctor --config run", False),
        ("vim arm-companion", False),
        ("python -m other run", False),
    ],
)
def test_a_daemon_is_known_by_its_command_line(line: str, daemon: bool, tmp_path: Path) -> None:
    assert is_daemon(line.split()) is daemon
    lay(tmp_path, "proc/42/cmdline", line.replace(" ", "\0") + "\0")
    assert machine(tmp_path).daemons() == ([42] if daemon else [])


@pytest.fixture
def quiet_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The command's machine, laid out below a directory; no log."""
    monkeypatch.setattr(command, "machine", lambda: machine(tmp_path))
    monkeypatch.setattr(report, "journal", lambda: "daemon: password=hunter2 in the log\n")
    monkeypatch.setitem(report.contents.__kwdefaults__ or {}, "log", report.journal)
    return tmp_path


def test_the_parameters_that_the_service_has_kept_are_in_force(
    quiet_machine: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nobody at a prompt has the variable that systemd sets for the service."""
    monkeypatch.setattr(os, "environ", {k: v for k, v in os.environ.items() if k != "STATE_DIRECTORY"})
    monkeypatch.setitem(command._SERVICE, "STATE_DIRECTORY", tmp_path)
    (tmp_path / "parameters.json").write_text('{"perch.wrap_bend_rad": 3.0}', encoding="utf-8")
    arguments = argparse.Namespace(config="sim.toml", settings=[], offline=True)
    seen = command.look(arguments, machine(tmp_path))
    assert seen.config is not None
    assert seen.config.perch.wrap_bend_rad == 3.0


@pytest.fixture
def open_place(quiet_machine: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The same machine below a directory into which other users see, as they do not into pytest's own."""
    assert quiet_machine.is_dir()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        place.chmod(0o755)
        monkeypatch.setattr(command, "machine", lambda: machine(place))
        yield place


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may read and write everything")
def test_root_sees_what_the_services_user_may_not(
    open_place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`sudo arm-companion doctor`: a key of root's, and a directory of root's, are well for root alone."""
    monkeypatch.setattr(command, "_USER", "nobody")
    key = open_place / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    file = open_place / "config.toml"
    file.write_text(
        f'[links.autopilot]\nurl = "udpin:127.0.0.1:1"\nrole = "autopilot"\nsigning_key = "{key}"\n'
        f'[record]\ndirectory = "{open_place}"\n',
        encoding="utf-8",
    )
    rows = {}
    for system_file in (file, open_place / "another.toml"):
        monkeypatch.setattr(command, "SYSTEM_FILE", system_file)
        main(["doctor", "--offline", "--json", "--config", str(file)])
        rows[system_file] = {row["check"]: row for row in json.loads(capsys.readouterr().out)["checks"]}
        assert os.geteuid() == 0
    assert "Permission denied" in rows[file]["configuration"]["found"]
    assert "cannot be written by this user" in rows[file]["disk"]["found"]
    assert rows[open_place / "another.toml"]["configuration"]["level"] == "ok"


def test_while_the_daemon_runs_nothing_is_opened(
    quiet_machine: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> object:
        raise AssertionError("opened")

    lay(quiet_machine, "proc/4711/cmdline", "arm-companion\0run\0--config\0x\0")
    monkeypatch.setattr(command, "open_bus", refuse)
    monkeypatch.setattr(command, "open_url", refuse)
    main(["doctor", "--config", "sim.toml", "--json"])
    rows = {row["check"]: row for row in json.loads(capsys.readouterr().out)["checks"]}
    for name in ("servos", "link"):
        assert rows[name]["level"] == "skipped"
        assert "process 4711" in rows[name]["found"]


# the command


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
    return port


def call(folder: Path, *words: str) -> int:
    url = f"links.autopilot.url=udpin:127.0.0.1:{free_port()}"
    bus = f"servos.port={folder / 'no-bus'}"
    return main(["doctor", "--config", "sim.toml", "--set", url, "--set", bus, "--patience", "0.1", *words])


def test_without_hardware_it_tells_what_is_missing_and_fails(
    quiet_machine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(quiet_machine) == 2
    text = capsys.readouterr().out
    assert "nothing comes" in text
    assert "no-bus" in text
    assert "why: " in text
    assert "do:  " in text
    assert call(quiet_machine, "--offline") == 1  # warnings alone


def test_json_has_every_check_with_found_why_and_do(quiet_machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(quiet_machine, "--json") == 2
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] == "fail"
    assert {row["check"] for row in told["checks"]} == {check.name for check in command.CHECKS}
    for row in told["checks"]:
        assert set(row) == {"check", "level", "found", "why", "do"}
        assert row["level"] in {"ok", "warn", "fail", "skipped"}


def test_a_bad_configuration_is_code_78_with_the_other_checks(
    quiet_machine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(quiet_machine, "--set", "vehicle.mass_kg=-1", "--json") == 78
    rows = {row["check"]: row for row in json.loads(capsys.readouterr().out)["checks"]}
    assert "vehicle.mass_kg" in rows["configuration"]["found"]
    assert rows["versions"]["level"] == "ok"


@pytest.mark.parametrize("text", ["0", "1e9", "nan"])
def test_a_patience_out_of_bounds_is_refused(text: str) -> None:
    with pytest.raises((argparse.ArgumentTypeError, SystemExit)):
        main(["doctor", "--config", "sim.toml", "--patience", text])


# the report


def members(path: Path) -> dict[str, str]:
    with tarfile.open(path) as archive:
        files = [(m.name.partition("/")[2], archive.extractfile(m)) for m in archive.getmembers()]
        return {name: file.read().decode() for name, file in files if file is not None}


def test_the_report_holds_what_helps_and_no_secret(quiet_machine: Path) -> None:
    key, password = "ab" * 32, "correct horse battery"
    (quiet_machine / "key").write_text(key, encoding="ascii")
    (quiet_machine / "key").chmod(0o600)
    (quiet_machine / "broker-password").write_text(password + "\n", encoding="ascii")
    lay(quiet_machine, "base.toml", "[perch]\nbar_radius_m = 0.035\n")
    file = quiet_machine / "arm.toml"
    file.write_text(
        f'extends = "base.toml"\n# note to self: the broker takes {password}\n'
        f'[links.autopilot]\nsigning_key = "{quiet_machine / "key"}"\n'
        f'[mqtt]\npassword_file = "{quiet_machine / "broker-password"}"\ntoken = "t0k3n-value"\n',
        encoding="utf-8",
    )
    target = quiet_machine / "report.tar.gz"
    code = main(["doctor", "--config", str(file), "--offline", "--report", str(target),
                 "--set", 'vehicle.api_key="sk-123456"'])  # fmt: skip
    assert code == 78  # token and api_key are no options: the report is made all the same
    assert target.stat().st_mode & 0o777 == 0o600
    files = members(target)
    assert {"doctor.json", "system.txt", "packages.txt", "log.txt", "config/arm.toml", "config/base.toml"} <= set(files)
    whole = "\n".join(files.values())
    for secret in (key, password, "hunter2", "t0k3n-value", "sk-123456"):
        assert secret not in whole, secret
    assert HIDDEN in whole
    assert "bar_radius_m = 0.035" in files["config/base.toml"]
    assert main(["doctor", "--config", "sim.toml", "--offline", "--report", str(target)]) == 1  # a second run replaces
    assert "config/arm.toml" not in members(target)


def test_a_report_that_cannot_be_written_is_told(quiet_machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(quiet_machine, "--offline", "--report", str(quiet_machine / "no" / "report.tar.gz")) == 2
    assert "No such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "secret"),
    [
        ('password = "se cret"', "se cret"),
        ("Password: secret1", "secret1"),
        ("broker_passwd=secret1,", "secret1"),
        ('{"api_token": "secret1"}', "secret1"),
        ("token = '''secret1\nsecret2'''", "secret2"),
        ("keys.secret = ['secret1', 'x']", "secret1"),
        ("mqtts://user:secret1@broker:8883", "secret1"),
        ("Authorization: Bearer secret1secret2", "secret1"),
        ("-----BEGIN PRIVATE KEY-----\nc2VjcmV0\n-----END PRIVATE KEY-----", "c2VjcmV0"),
        ("-----BEGIN EC PRIVATE KEY-----\nc2VjcmV0", "c2VjcmV0"),
        ("signing with " + "0f" * 32, "0f0f"),
        ('signing_key = "/etc/secret1"', "secret1"),
    ],
)
def test_secrets_in_many_forms_are_taken_out(text: str, secret: str) -> None:
    assert secret not in redact(text)
    assert HIDDEN in redact(text)


def test_what_is_no_secret_stays() -> None:
    text = 'mass_kg = 1.8\nurl = "udpin:127.0.0.1:14540"\nlink ground: open\nmonkey = 3\n'
    assert redact(text) == text


def test_known_secrets_are_taken_out_wherever_they_are() -> None:
    assert redact("the log says hunter2x and hunter2", ["hunter2", "abc", ""]) == f"the log says {HIDDEN}x and {HIDDEN}"


# a real daemon


@pytest.mark.realtime
def test_a_daemon_that_really_runs_is_seen_and_left_alone(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "arm_companion", "run", "--config", "sim.toml"]
    for setting in (
        f"links.autopilot.url=udpin:127.0.0.1:{free_port()}",
        f"links.ground.url=udpout:127.0.0.1:{free_port()}",
        f"servos.port={tmp_path / 'no-bus'}",
    ):
        words += ["--set", setting]
    process = subprocess.Popen(words, stderr=subprocess.PIPE)
    try:
        assert process.pid in command.machine().daemons()
    finally:
        process.kill()
        process.communicate()
    assert process.pid not in command.machine().daemons()


def test_what_the_configuration_needs_and_is_not_installed_is_told(
    subject: Subject, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec
    gone: set[str] = set()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name in gone else real(name, *rest))
    publishes = with_(subject, config={"mqtt": MqttConfig(host="localhost")})
    assert found(publishes, "configuration").level is Level.OK
    gone.add("aiomqtt")
    assert found(publishes, "configuration").level is Level.WARN
    assert found(subject, "configuration").level is Level.OK
    gone.add("mcap")
    told = found(subject, "configuration")
    assert told.level is Level.FAIL
    assert "arm-companion[record]" in told.found
    assert found(with_(subject, config={"record": RecordConfig()}), "configuration").level is Level.OK


def test_a_report_over_an_older_file_is_for_its_maker_alone(tmp_path: Path) -> None:
    path = tmp_path / "report.tar.gz"
    path.write_bytes(b"older")
    path.chmod(0o644)
    report.write(path, {"log.txt": "x"}, NOW)
    assert path.stat().st_mode & 0o777 == 0o600
