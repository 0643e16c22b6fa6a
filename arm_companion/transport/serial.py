"""A serial device, or a pseudo-terminal, as a transport.

pyserial opens and configures the device; bytes then pass between its descriptor and the event loop without a
layer between, because a servo bus wakes the process a few hundred times a second.
"""

import asyncio
import contextlib
import errno
import logging
import os
import termios
from collections import deque
from pathlib import Path

import serial

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Receiver

_log = logging.getLogger(__name__)

BACKLOG_BYTES = 4096
"""What may wait to be sent before the oldest of it is dropped: 40 ms at 1 Mbit/s."""

LONGEST_LATENCY_TIMER_MS = 4
"""An adapter whose latency timer is longer spoils a servo bus; FTDI ships 16 ms."""

_READ_SIZE = 4096
_FAILURES = (OSError, termios.error)
"""What pyserial raises of a device: its SerialException is an OSError, what it passes on from termios is none."""


class SerialPort:
    """An open serial device.

    Args:
        device: open and non-blocking; closed with the port.
        receiver: takes what arrives.
    """

    def __init__(self, device: serial.Serial, receiver: Receiver) -> None:
        self.dropped = 0
        self._device = device
        self._descriptor: int = device.fileno()
        self._receiver = receiver
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._begun = False  # the first of what waits is the rest of a chunk: half of it has been sent
        self._gone = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._descriptor, self._read)

    def write(self, data: bytes) -> None:
        """Send `data`; of what has to wait, the oldest is dropped when it is too much, but never half a chunk."""
        if self._gone.is_set() or not data:
            return
        if not self._waiting:
            sent = self._send(data)
            if sent == len(data) or self._gone.is_set():
                return
            self._begun, data = sent > 0, data[sent:]
            self._loop.add_writer(self._descriptor, self._write_waiting)
        self._waiting.append(data)
        self._waiting_bytes += len(data)
        while self._waiting_bytes > BACKLOG_BYTES and len(self._waiting) > 1 + self._begun:
            # half a frame would spoil the one behind it, too
            self._waiting_bytes -= len(self._waiting[self._begun])
            del self._waiting[self._begun]
            self.dropped += 1

    def close(self) -> None:
        """Release the device; what is still to be sent is lost."""
        if self._gone.is_set():
            return
        self._gone.set()
        self._loop.remove_reader(self._descriptor)
        self._loop.remove_writer(self._descriptor)
        self._waiting.clear()
        with contextlib.suppress(OSError, serial.SerialException):
            self._device.close()

    async def wait_closed(self) -> None:
        """Return when the device is released or lost."""
        await self._gone.wait()

    def _read(self) -> None:
        try:
            data = os.read(self._descriptor, _READ_SIZE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._lose(error)
            return
        if data:
            self._receiver(data)
        else:
            self._lose("hung up")

    def _send(self, data: bytes) -> int:
        """How many bytes the kernel took."""
        try:
            return os.write(self._descriptor, data)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as error:
            self._lose(error)
            return 0

    def _write_waiting(self) -> None:
        while self._waiting:
            sent = self._send(self._waiting[0])
            self._waiting_bytes -= sent
            if self._gone.is_set():
                return
            if sent < len(self._waiting[0]):
                self._begun |= sent > 0
                self._waiting[0] = self._waiting[0][sent:]
                return
            self._waiting.popleft()
            self._begun = False
        self._loop.remove_writer(self._descriptor)

    def _lose(self, why: object) -> None:
        _log.warning("serial device %s lost: %s", self._device.port, why)
        self.close()


def open_serial(port: str, baud: int) -> Opener:
    """An `Opener` of a serial device, for this process alone.

    The kernel's low-latency mode is asked for where the driver has it (it takes the latency timer of an FTDI
    adapter from 16 ms to 1 ms). Bytes that came before the device was opened are thrown away.

    Args:
        port: device, such as /dev/ttyUSB0.
        baud: bits per second.

    The opener raises `LinkError` when the device is missing, may not be used, is in use, or does not know the
    speed.
    """

    async def open_port(receiver: Receiver) -> SerialPort:
        try:
            device = serial.Serial(port, baudrate=baud, timeout=0, write_timeout=0, exclusive=True)
        except (*_FAILURES, ValueError) as error:
            raise LinkError(f"cannot open {port} at {baud} bit/s: {_reason(error)}") from error
        try:
            _prefer_latency(device)
            device.reset_input_buffer()
        except _FAILURES as error:
            with contextlib.suppress(OSError):
                device.close()
            raise LinkError(f"{port} was lost while it was opened: {_reason(error)}") from error
        return SerialPort(device, receiver)

    return open_port


def _reason(error: Exception) -> object:
    code = error.args[0] if isinstance(error, termios.error) else getattr(error, "errno", None)
    if code in {errno.EAGAIN, errno.EBUSY}:
        return "another program holds its lock (the daemon, or another command on the servo bus)"
    return os.strerror(code) if code else error


def latency_timer_ms(port: str, sysfs: Path = Path("/sys")) -> int | None:
    """How long a USB adapter collects bytes before it passes them on, ms; None where there is no such timer.

    Args:
        port: device, or a link to it such as those in /dev/serial/by-id.
        sysfs: where the kernel shows its devices.
    """
    name = Path(os.path.realpath(port)).name
    try:
        return int((sysfs / "bus/usb-serial/devices" / name / "latency_timer").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def latency_advice(port: str, sysfs: Path = Path("/sys")) -> str:
    """What is wrong with an adapter's latency timer and what to do, or nothing."""
    timer = latency_timer_ms(port, sysfs)
    if timer is None or timer <= LONGEST_LATENCY_TIMER_MS:
        return ""
    return (
        f"{port}: the USB adapter's latency timer is {timer} ms, so every answer of a servo comes that late; "
        "install systemd/99-arm-companion.rules as a udev rule, which sets 1 ms"
    )


def _prefer_latency(device: serial.Serial) -> None:
    with contextlib.suppress(OSError, ValueError, NotImplementedError):  # a pty and most UARTs know no such mode
        device.set_low_latency_mode(True)
    if advice := latency_advice(str(device.port)):
        _log.warning("%s", advice)
