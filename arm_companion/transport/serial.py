"""A serial device, or a pseudo-terminal, as a transport."""

import asyncio
import contextlib
import logging

import serial
from serial_asyncio_fast import SerialTransport, create_serial_connection

from arm_companion.errors import LinkError
from arm_companion.transport.base import Opener, Receiver

_log = logging.getLogger(__name__)

BACKLOG_BYTES = 4096
"""What may wait to be sent before the oldest of it is dropped: 40 ms at 1 Mbit/s."""


class SerialPort(asyncio.Protocol):
    """An open serial device."""

    def __init__(self, receiver: Receiver) -> None:
        self.dropped = 0
        self._receiver = receiver
        self._waiting = 0  # chunks, since the backlog was last empty
        self._transport: SerialTransport | None = None
        self._gone = asyncio.Event()

    def write(self, data: bytes) -> None:
        """Send `data`; a backlog that has grown too long is dropped first."""
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        backlog = transport.get_write_buffer_size()
        if not backlog:
            self._waiting = 0
        elif backlog + len(data) > BACKLOG_BYTES:
            transport.flush()
            self.dropped += self._waiting
            self._waiting = 0
        transport.write(data)
        self._waiting += 1

    def close(self) -> None:
        """Release the device; what is still to be sent is lost."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.abort()

    async def wait_closed(self) -> None:
        """Return when the device is released or lost."""
        await self._gone.wait()

    # What the event loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take over the open device."""
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Pass on what arrived."""
        self._receiver(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell whoever waits that the device is gone."""
        if exc is not None:
            _log.warning("serial device lost: %s", exc)
        self._transport = None
        self._gone.set()


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
        opened = SerialPort(receiver)
        try:
            transport, _ = await create_serial_connection(
                asyncio.get_running_loop(), lambda: opened, port, baudrate=baud, exclusive=True
            )
        except (OSError, ValueError) as error:  # serial.SerialException is an OSError
            raise LinkError(f"cannot open {port} at {baud} bit/s: {error}") from error
        opened.connection_made(transport)  # the loop would do so one turn later
        _prefer_latency(transport.serial)
        return opened

    return open_port


def _prefer_latency(device: serial.Serial) -> None:
    with contextlib.suppress(OSError, ValueError, NotImplementedError):  # a pty and most UARTs know no such mode
        device.set_low_latency_mode(True)
    with contextlib.suppress(OSError, serial.SerialException):
        device.reset_input_buffer()
