"""`servos scan|setup|monitor` as commands, with emulated servos and simulated time behind their port."""

import asyncio
import dataclasses
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import pytest
import serial

from arm_companion.__main__ import main
from arm_companion.cli import servos as command
from arm_companion.clock import run_simulated
from arm_companion.config import load
from arm_companion.config.schema import ServosConfig
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.servo_monitor import ServoMonitor
from arm_companion.errors import LinkError, ProtocolError
from arm_companion.protocol import control_table as ct
from arm_companion.protocol.control_table import HardwareError, OperatingMode
from arm_companion.protocol.dynamixel import StatusError
from arm_companion.sim.byte_noise import ByteNoise
from arm_companion.sim.servo_device import EmulatedServo
from arm_companion.sim.servo_emulator import EmulatedBus, ServoEmulator, keep_time
from arm_companion.transport.base import Opener, Receiver, Transport
from arm_companion.transport.memory import MemoryPipe
from arm_companion.transport.serial import latency_advice, latency_timer_ms
from arm_companion.transport.trace import FIRST_LINE, ReplayedPipe, read_trace, recorded, replayed

CONFIG = ServosConfig()
TRACE = Path(__file__).parents[1] / "data" / "servo_bus.trace"
TRACE_FRAMES, TRACE_DAMAGED = 610, 27


class Bench:
    """A bus with emulated servos that commands open at any speed."""

    def __init__(self) -> None:
        self.serve(CONFIG)
        self.opened: list[int] = []
        self.wires: list[EmulatedBus] = []
        self.fails_at: set[int] = set()
        self.on_open: Callable[[EmulatedBus], None] = lambda _: None

    def serve(self, config: ServosConfig) -> None:
        """Put the servos of another configuration on the bus."""
        self.config, self.emulator = config, ServoEmulator(config, seed=8)

    def open_bus(self, port: str, baud: int) -> Opener:
        async def open_port(receiver: Receiver) -> Transport:
            if baud in self.fails_at:
                raise LinkError(f"cannot open {port} at {baud} bit/s: not with this adapter")
            self.opened.append(baud)
            wire = EmulatedBus(self.emulator, dataclasses.replace(self.config, baud=baud))
            self.on_open(wire)
            pipe = MemoryPipe(latency_s=0.0001)
            tasks = [
                asyncio.create_task(wire.serve_memory(pipe.opener(0))),
                asyncio.create_task(keep_time(self.emulator)),
            ]
            await wire.wait_ready()
            end = await pipe.opener(1)(receiver)
            closed = end.close

            def close() -> None:
                for task in tasks:
                    task.cancel()
                closed()

            end.close = close  # type: ignore[method-assign]
            return end

        return open_port

    def new(self, index: int, servo_id: int = 1, baud_code: int = 1) -> EmulatedServo:
        """Make a servo as it comes from the factory."""
        servo = self.emulator.servos[index]
        for register in ct.REGISTERS.values():
            if register.eeprom and register.writable:
                servo.poke(register, register.initial)
        servo.poke(ct.ID, servo_id)
        servo.poke(ct.BAUD_RATE, baud_code)
        return servo


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    bench = Bench()
    monkeypatch.setattr(command, "open_bus", bench.open_bus)
    monkeypatch.setattr(command, "run_real_time", run_simulated)
    return bench


def call(*words: str) -> int:
    return main(["servos", *words, "--config", "sim.toml", "--port", "/dev/ttyTEST"])


# scan


def test_scan_finds_what_is_there_at_every_speed(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.new(2)
    assert call("scan") == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines[:4]] == ["1", "2", "4", "1"]
    assert "tendon 4" in lines[2]
    assert "57600" in lines[3]
    assert "`servos setup`" in lines[3]
    assert lines[4] == "missing at 1000000 bit/s: 3"
    assert sorted(bench.opened) == sorted(ct.BAUD_CODES.values())


def test_scan_is_well_when_all_answer_and_speaks_json(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("scan", "--baud", "1000000", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [servo["id"] for servo in found] == [1, 2, 3, 4]
    assert all(servo["firmware"] == 46 and not servo["crowded"] for servo in found)
    assert bench.opened == [1_000_000]


def test_a_grippers_servo_is_found_and_set_up_like_the_others(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    gripped = ["--config", "sim_gripper.toml", "--port", "/dev/ttyTEST"]
    bench.serve(load("sim_gripper.toml").bus_servos)
    new = bench.new(4)
    assert main(["servos", "scan", "--baud", "1000000", *gripped]) == 1
    assert "missing at 1000000 bit/s: 5" in capsys.readouterr().out
    assert main(["servos", "setup", "--yes", *gripped]) == 0
    assert (new.id, new.baud) == (5, 1_000_000)
    assert main(["servos", "scan", "--baud", "1000000", *gripped]) == 0
    assert "gripper" in capsys.readouterr().out.splitlines()[-1]


def test_scan_sees_two_servos_with_one_id(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.emulator.servos[3].poke(ct.ID, 2)
    assert call("scan", "--baud", "1000000") == 1
    out = capsys.readouterr().out
    assert "id   2" in out
    assert "two servos with this id" in out
    assert out.count("two servos") == 1


def test_scan_lives_with_speeds_that_the_adapter_has_not(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.fails_at = {4_500_000, 4_000_000}
    assert call("scan") == 0
    assert "not with this adapter" in capsys.readouterr().err
    bench.fails_at = set(ct.BAUD_CODES.values())
    assert call("scan") == 1
    assert "arm-companion: cannot open /dev/ttyTEST" in capsys.readouterr().err


def test_a_port_that_is_not_there_is_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["servos", "scan", "--config", "sim.toml", "--port", str(tmp_path / "none")]) == 1
    assert capsys.readouterr().err.count("cannot open") == 1


def test_scan_writes_nothing(bench: Bench) -> None:
    before = [dict(servo.values) for servo in bench.emulator.servos]
    assert call("scan") == 0
    for servo, values in zip(bench.emulator.servos, before, strict=True):
        assert {a: v for a, v in servo.values.items() if ct.REGISTERS[a].writable} == {
            a: v for a, v in values.items() if ct.REGISTERS[a].writable
        }


# setup


def settings(servo: EmulatedServo) -> dict[str, int]:
    return {register.name: servo.peek(register) for register in ct.REGISTERS.values() if register.eeprom}


def test_setup_turns_a_new_servo_into_the_one_that_is_missing(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    new = bench.new(2)
    others = [settings(bench.emulator.servos[i]) for i in (0, 1, 3)]
    assert call("setup", "--yes") == 0
    assert (new.id, new.baud) == (3, 1_000_000)
    assert new.peek(ct.OPERATING_MODE) == OperatingMode.EXTENDED_POSITION
    assert (new.peek(ct.RETURN_DELAY), new.peek(ct.TEMPERATURE_LIMIT)) == (0, 72)
    assert (new.peek(ct.MIN_VOLTAGE_LIMIT), new.peek(ct.MAX_VOLTAGE_LIMIT)) == (95, 140)
    assert new.peek(ct.TORQUE_ENABLE) == 0
    assert [settings(bench.emulator.servos[i]) for i in (0, 1, 3)] == others
    out = capsys.readouterr().out
    assert "servo 1 at 57600 bit/s" in out
    assert "is to be servo 3 at 1000000 bit/s" in out
    assert "250 -> 0" in out
    assert "read back right" in out
    assert call("setup", "--id", "3", "--yes") == 0
    assert "nothing to be written" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--dry-run"], []])
def test_setup_writes_nothing_unless_told(
    bench: Bench, capsys: pytest.CaptureFixture[str], words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: False)
    new = bench.new(0)
    before = settings(new)
    assert call("setup", *words) == 0
    assert "nothing was written" in capsys.readouterr().out
    assert settings(new) == before


@pytest.mark.parametrize(("answer", "done"), [("y", True), ("", False), ("no", False)])
def test_setup_asks_a_person(
    bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, answer: str, done: bool
) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda _: answer)
    new = bench.new(0)
    assert call("setup") == 0
    assert (new.baud == 1_000_000) == done


@pytest.mark.parametrize("key", ["\x03", "\x04"])
def test_setup_takes_an_interrupt_and_the_end_of_input_for_a_no(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, key: str
) -> None:
    typed = iter((key, "y"))

    def ask(_: str) -> str:
        match next(typed):
            case "\x03":
                signal.raise_signal(signal.SIGINT)
                return ask(_)  # whoever does not end there goes on reading
            case "\x04":
                raise EOFError
        return "y"

    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", ask)
    before, handler = settings(bench.new(0)), signal.getsignal(signal.SIGINT)
    assert call("setup") == (130 if key == "\x03" else 0)
    assert settings(bench.emulator.servos[0]) == before
    assert next(typed) == "y", "it was asked no further"
    assert signal.getsignal(signal.SIGINT) is handler


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert call("setup", "--yes", *words) == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_setup_refuses_what_is_not_clear(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    before = [settings(servo) for servo in bench.emulator.servos]
    assert "name the one to be looked after" in refusal(capsys)
    assert "id 9 is none of the arm's servos" in refusal(capsys, "--id", "9")
    assert [settings(servo) for servo in bench.emulator.servos] == before
    bench.new(2)
    assert "id 2 is taken already" in refusal(capsys, "--id", "2")
    bench.new(3, baud_code=2)
    assert "connect one new servo at a time" in refusal(capsys)
    bench.new(3)
    assert "two servos with one id" in refusal(capsys)
    bench.emulator.servos[3].poke(ct.ID, 4)
    bench.emulator.servos[3].poke(ct.BAUD_RATE, 3)
    bench.emulator.servos[2].poke(ct.TORQUE_ENABLE, 1)
    assert "torque of servo 1 is on" in refusal(capsys)
    bench.emulator.servos[2].poke(ct.TORQUE_ENABLE, 0)
    bench.emulator.servos[2].poke(ct.FIRMWARE_VERSION, 30)
    assert "without bus watchdog" in refusal(capsys)
    bench.emulator.servos[2].poke(ct.MODEL_NUMBER, 1190)
    assert "not an XL430" in refusal(capsys)
    bench.emulator.servos[2].silenced = True
    assert "no new servo answers" in refusal(capsys)


def test_setup_needs_a_speed_that_servos_have(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["servos", "setup", "--config", "sim.toml", "--set", "servos.baud=500000"]) == 78
    assert "servos.baud = 500000 is no speed" in capsys.readouterr().err


@pytest.mark.parametrize("writes", range(5))
def test_setup_goes_on_after_an_interruption_wherever_it_came(
    bench: Bench, capsys: pytest.CaptureFixture[str], writes: int
) -> None:
    new = bench.new(1)
    left = writes
    obey = new.write

    def fail(address: int, data: bytes) -> StatusError:
        nonlocal left
        left -= 1
        new.silenced = left < 0
        return StatusError.RESULT_FAIL if new.silenced else obey(address, data)

    new.write = fail  # type: ignore[method-assign]
    assert call("setup", "--yes") == 1
    assert "servo " in capsys.readouterr().err
    new.silenced = False
    new.write = obey  # type: ignore[method-assign]
    assert call("setup", "--yes", "--id", "2") == 0
    assert (new.id, new.baud, new.peek(ct.OPERATING_MODE)) == (2, 1_000_000, 4)


# monitor


def test_monitor_tells_all_once(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("monitor", "--once") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    assert lines[1].split()[:4] == ["1", "46", "2048", "0"]
    assert all(line.endswith("well") for line in lines[1:5])
    assert "0 damaged" in lines[5]


def test_monitor_names_faults_and_fails(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.emulator[2].silenced = True
    bench.emulator[3].trip(HardwareError.OVERLOAD)
    bench.emulator[4].poke(ct.BUS_WATCHDOG, ct.WATCHDOG_TRIPPED)
    assert call("monitor", "--once") == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].endswith("does not answer")
    assert lines[3].endswith("hardware error 0x20: overload")
    assert lines[4].endswith("its bus watchdog stopped it")
    assert bench.emulator[4].peek(ct.BUS_WATCHDOG) == ct.WATCHDOG_TRIPPED


def test_monitor_speaks_json_and_records_what_it_hears(
    bench: Bench, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "bus.trace"
    assert call("monitor", "--once", "--json", "--trace", str(path)) == 0
    reading = json.loads(capsys.readouterr().out)
    assert [servo["position"] for servo in reading["servos"]] == [2048] * 4
    assert reading["bus"]["servos"]["1"]["lost"] == 0
    assert path.read_text(encoding="ascii").startswith(FIRST_LINE)
    assert len(read_trace(path.read_text(encoding="ascii").splitlines())) > 20
    assert call("monitor", "--once", "--trace", str(tmp_path / "no" / "where")) == 78


def test_monitor_writes_nothing(bench: Bench) -> None:
    before = [dict(servo.values) for servo in bench.emulator.servos]
    assert call("monitor", "--once") == 0
    for servo, values in zip(bench.emulator.servos, before, strict=True):
        assert all(servo.values[a] == v for a, v in values.items() if ct.REGISTERS[a].writable)


@pytest.mark.parametrize("words", [["scan"], ["setup", "--yes"], ["monitor", "--once"]])
def test_a_port_that_the_daemon_holds_is_refused(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    master, slave = os.openpty()
    port = os.ttyname(slave)
    with serial.Serial(port, exclusive=True):
        assert main(["servos", *words, "--config", "sim.toml", "--port", port]) == 1
    assert "another program holds its lock" in capsys.readouterr().err
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["monitor", "--rate", "900"], "0.1 to 200 Hz"),
        (["monitor", "--rate", "fast"], "is no rate"),
        (["scan", "--baud", "1234"], "is none of 9600"),
        (["setup", "--id", "253"], "is no servo id"),
        (["scan", "--id", "-1"], "is no servo id"),
    ],
)
def test_bad_words_are_refused(capsys: pytest.CaptureFixture[str], words: list[str], text: str) -> None:
    with pytest.raises(SystemExit) as caught:
        call(*words)
    assert caught.value.code == 2
    assert text in capsys.readouterr().err


# A recorded trace.


Seen = tuple[list[tuple[ServoState, ...]], tuple[int, int, dict[int, int]]]


async def watch(opener: Opener, n: int = 60) -> Seen:
    """What a monitor sees of a bus: for each read the states without their times; frames, damaged ones, losses."""
    monitor = ServoMonitor(opener, CONFIG)
    await monitor.open()
    seen = []
    for _ in range(n):
        seen.append(tuple(dataclasses.replace(state, age_s=0.0) for state in await monitor.read()))
        await asyncio.sleep(0.01)
    counters = monitor.counters()
    await monitor.close()
    return seen, (counters.frames, counters.crc_errors, {i: c.lost for i, c in counters.servos.items()})


def test_a_recorded_trace_replays_through_the_driver_to_the_same_states(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "bus.trace"

    def noisy(wire: EmulatedBus) -> None:
        wire.to_servos, wire.to_master = ByteNoise(0.003, 0.003, seed=1), ByteNoise(0.003, 0.003, seed=2)

    bench.on_open = noisy
    bench.emulator[3].trip(HardwareError.OVERHEATING)
    with path.open("w", encoding="ascii") as stream:
        before = run_simulated(watch(recorded(bench.open_bus("", CONFIG.baud), stream)))
    chunks = read_trace(path.read_text(encoding="ascii").splitlines())
    assert run_simulated(watch(replayed(chunks))) == before
    _, (frames, damaged, lost) = before
    assert frames > 100
    assert damaged > 5
    assert sum(lost.values()) > 10


def record_kept_trace(stream: TextIO) -> None:
    """How the kept trace was made: a bus that damages one byte in 500, and servo 2 silent for a third of it."""
    bench = Bench()

    def noisy(wire: EmulatedBus) -> None:
        wire.to_master = ByteNoise(0.001, 0.001, seed=1)
        loop = asyncio.get_running_loop()
        for after, silenced in ((0.6, True), (1.2, False)):
            loop.call_later(after, setattr, bench.emulator[2], "silenced", silenced)

    bench.on_open = noisy
    run_simulated(watch(recorded(bench.open_bus("", CONFIG.baud), stream), 150))


def test_the_trace_that_is_kept_still_means_the_same() -> None:
    chunks = read_trace(TRACE.read_text(encoding="ascii").splitlines())
    pipes: list[ReplayedPipe] = []

    async def open_and_keep(receiver: Receiver) -> Transport:
        pipes.append(ReplayedPipe(chunks, receiver))
        return pipes[0]

    states, (frames, damaged, lost) = run_simulated(watch(open_and_keep, 150))
    assert pipes[0].unmatched + pipes[0].left < 0.1 * sum(chunk.sent for chunk in chunks)
    assert (frames, damaged) == pytest.approx((TRACE_FRAMES, TRACE_DAMAGED), rel=0.1)
    assert min(lost.values()) > 0
    silent = [row[1].silent for row in states]
    assert 30 < sum(silent) < 60
    assert not silent[-1], "it was heard again"
    assert all(row[i].position == 2048 for row in states[1:] for i in (0, 2, 3))


@pytest.mark.parametrize("line", ["0.1 > zz", "x > 00", "0.1 - 00", "0.1 >", "0.1 > 00 00"])
def test_a_line_that_is_no_chunk_is_named(line: str) -> None:
    with pytest.raises(ProtocolError, match="line 2"):
        read_trace(["0.0 > ff", line])


def test_a_trace_runs_forwards() -> None:
    with pytest.raises(ProtocolError, match="older"):
        read_trace(["1.0 > ff", "0.5 < ff"])


def test_what_a_trace_does_not_have_is_not_answered() -> None:
    async def main() -> None:
        heard: list[bytes] = []
        pipe = ReplayedPipe(read_trace(["0.0 > 01", "0.25 < 02", "0.5 > 03", "0.6 < 04"]), heard.append)
        loop = asyncio.get_running_loop()
        pipe.write(b"\x09")
        assert pipe.unmatched == 1
        pipe.write(b"\x01")
        await asyncio.sleep(0.3)
        assert heard == [b"\x02"]
        assert pipe.left == 1
        pipe.write(b"\x03")
        assert pipe.left == 0
        pipe.close()
        await asyncio.wait_for(pipe.wait_closed(), 1.0)
        await asyncio.sleep(0.2)
        assert heard == [b"\x02"], "a closed pipe is silent"
        assert loop.time() < 1.0

    run_simulated(main())


# The adapter's latency timer.


@pytest.mark.parametrize(("text", "timer", "advised"), [("16\n", 16, True), ("1\n", 1, False), ("?", None, False)])
def test_the_latency_timer_is_read_and_a_long_one_advised_against(
    tmp_path: Path, text: str, timer: int | None, advised: bool
) -> None:
    folder = tmp_path / "bus/usb-serial/devices/ttyUSB7"
    folder.mkdir(parents=True)
    (folder / "latency_timer").write_text(text, encoding="ascii")
    assert latency_timer_ms("/dev/ttyUSB7", tmp_path) == timer
    advice = latency_advice("/dev/ttyUSB7", tmp_path)
    assert bool(advice) == advised
    assert not advised or "99-arm-companion.rules" in advice
    link = tmp_path / "by-id"
    link.symlink_to("/dev/ttyUSB7")
    assert latency_timer_ms(str(link), tmp_path) == timer
    assert latency_timer_ms("/dev/ttyAMA0", tmp_path) is None
