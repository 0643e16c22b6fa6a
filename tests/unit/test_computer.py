"""What is told of the companion computer: read from a made-up machine, and from this one."""

import math
from pathlib import Path

import pytest

from arm_companion.drivers.computer import Computer, ComputerWatch, Load, look
from arm_companion.protocol.dialect import mav

MIB = 1024 * 1024


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A machine of two cores that throttles."""

    def put(name: str, text: str) -> None:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    put("proc/stat", "cpu 9 9 9 9\ncpu0 100 0 100 700 100 0 0 0 50 0\ncpu1 10 0 0 990 0 0 0 0 0 0\nintr 5\n")
    put("proc/uptime", "3600.50 7000.0\n")
    put("proc/meminfo", "MemTotal: 4096000 kB\nMemFree: 1 kB\nMemAvailable: 1024000 kB\n")
    put("sys/class/thermal/thermal_zone0/temp", "48500\n")
    put("sys/class/thermal/thermal_zone1/temp", "61200\n")
    put("sys/devices/platform/soc/soc:firmware/get_throttled", "50005\n")
    return tmp_path


def test_everything_that_the_machine_tells_is_read(machine: Path) -> None:
    seen = look(machine, machine)
    assert seen.uptime_s == 3600.5
    assert seen.cores == (Load(200, 1000), Load(10, 1000))  # waiting for a disk is no work
    assert seen.temperature_c == 61.2
    assert seen.memory == (3072000 * 1024.0, 4096000 * 1024.0)
    assert seen.storage is not None
    assert 0 < seen.storage[0] <= seen.storage[1]
    assert seen.flags & ~mav.COMPUTER_STATUS_FLAGS_DISK_FULL == (
        mav.COMPUTER_STATUS_FLAGS_UNDER_VOLTAGE | mav.COMPUTER_STATUS_FLAGS_CPU_THROTTLE
    )


@pytest.mark.parametrize("text", ["", "nonsense\n", "cpu0\n", "cpu0 a b c\n"])
def test_what_cannot_be_read_is_not_known(tmp_path: Path, text: str) -> None:
    for name in ("stat", "uptime", "meminfo"):
        (tmp_path / "proc").mkdir(exist_ok=True)
        (tmp_path / "proc" / name).write_text(text)
    seen = look(tmp_path, tmp_path / "none")
    assert math.isnan(seen.uptime_s)
    assert math.isnan(seen.temperature_c)
    assert (seen.memory, seen.storage, seen.flags) == (None, None, 0)


def test_an_unknown_machine_is_told_as_unknown() -> None:
    message = ComputerWatch().message(5)
    fields = message.to_dict()
    assert fields["time_usec"] == 5
    assert set(fields["cpu_cores"]) == {255}
    assert set(fields["temperature_core"]) == {127}
    assert fields["ram_usage"] == fields["ram_total"] == 0xFFFFFFFF
    assert set(fields["storage_usage"]) == {0xFFFFFFFF}


def test_load_is_of_the_time_between_two_looks() -> None:
    watch = ComputerWatch()
    watch.see(Computer(cores=(Load(100, 1000), Load(0, 1000))))
    watch.see(Computer(10.0, (Load(150, 1100), Load(100, 1100)), -3.4, (512.0 * MIB, 1024.0 * MIB), None, 2))
    fields = watch.message(1).to_dict()
    assert fields["cpu_cores"] == [50, 100, *[255] * 6]
    assert fields["temperature_core"] == [-3, *[127] * 7]
    assert (fields["ram_usage"], fields["ram_total"]) == (512, 1024)
    assert (fields["uptime"], fields["status_flags"]) == (10_000, 2)
    packed = watch.message(1).pack(mav.MAVLink(None))
    assert mav.MAVLink(None).parse_buffer(packed)[0].cpu_cores[:2] == [50, 100]


def test_a_machine_of_many_cores_or_with_a_core_that_went_away_is_told_as_far_as_it_can() -> None:
    watch = ComputerWatch()
    watch.see(Computer(cores=tuple(Load(0, 100) for _ in range(64))))
    watch.see(Computer(cores=tuple(Load(100, 200) for _ in range(64))))
    assert list(watch.message(1).to_dict()["cpu_cores"]) == [100] * 8
    watch.see(Computer(cores=(Load(100, 200),)))
    assert set(watch.message(1).to_dict()["cpu_cores"]) == {255}


def test_this_machine_answers() -> None:
    seen = look()
    assert seen.cores
    assert seen.memory is not None
    assert seen.memory[0] < seen.memory[1]
