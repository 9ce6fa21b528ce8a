"""A serial CAN adapter that speaks the Lawicel protocol, read in large pieces."""

from __future__ import annotations

import errno
import os
import select
import time

import serial
from can import CanInitializationError, CanOperationError, Message
from can.interfaces.slcan import slcanBus

_ENDS = (0x0D, 0x07)
_LINE_FEED = 0x0A
_LONGEST_LINE = 64


class SlcanBus(slcanBus):
    """python-can's slcan with five changes.

    The serial port is read in whatever pieces it has; byte by byte, as python-can does, a loaded
    machine falls up to 0.8 s behind. A write neither waits for the last bit to leave the port nor
    long for room, so that an adapter that takes nothing cannot hang the control loop.
    A line that is no frame is counted, not raised. Adapters that end their lines with CR and LF are
    understood: to python-can, the LF hides the frame behind it. The port is this program's alone.

    Parameters
    ----------
    channel : str
        The serial port's device file.
    bitrate : int
        Of the CAN bus [bit/s].
    tty_baudrate : int
        Of the serial port [bit/s]; USB adapters ignore it.
    write_timeout : float
        How long a write waits for room [s].
    """

    def __init__(
        self, channel: str, *, bitrate: int, tty_baudrate: int, write_timeout: float
    ) -> None:
        self._write_timeout = write_timeout
        self.malformed = 0
        self.refused = 0
        self._lines: list[str] = []
        self._channel_open = False
        self._bitrate = bitrate
        super().__init__(channel, tty_baudrate=tty_baudrate, bitrate=bitrate, sleep_after_open=0)

    def greet(self) -> None:
        """Tell the adapter the bitrate and to open its channel, whatever it was told before."""
        self.set_bitrate(self._bitrate)

    def set_bitrate(self, bitrate: int, data_bitrate: int | None = None) -> None:
        """Set the bitrate and open the channel; an unfinished line of a predecessor ends first.

        Raises
        ------
        CanInitializationError
            If another program has the port: frames of two would tear each other apart.
        """
        if not self._lock_port():
            raise CanInitializationError("another program uses it")
        self._write("")
        super().set_bitrate(bitrate, data_bitrate)

    def _lock_port(self) -> bool:
        try:
            self.serialPortOrig.exclusive = True
        except serial.SerialException as error:
            return error.errno not in (errno.EAGAIN, errno.EACCES)
        return True

    def open(self) -> None:
        """Open the channel, once: adapters refuse the second order that python-can gives."""
        if not self._channel_open:
            super().open()
            self._channel_open = True

    def close(self) -> None:
        """Close the channel."""
        self._channel_open = False
        super().close()

    def _write(self, string: str) -> None:
        data = string.encode() + self.LINE_TERMINATOR
        deadline = time.monotonic() + self._write_timeout
        try:
            port = self.serialPortOrig.fileno()
            while data:
                data = data[_write_now(port, data) :]
                wait = max(0.0, deadline - time.monotonic())
                if data and not select.select([], [port], [], wait)[1]:
                    raise CanOperationError(f"takes nothing for {self._write_timeout:g} s")
        except (serial.SerialException, OSError, TypeError, ValueError) as error:
            # pyserial raises TypeError where another thread has closed the port.
            raise CanOperationError(str(error)) from error

    def _read(self, timeout: float | None) -> str | None:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._lines:
            wait = None if deadline is None else deadline - time.monotonic()
            if wait is not None and wait < 0.0:
                return None
            self._read_piece(wait)
        return self._lines.pop(0)

    def _read_piece(self, wait: float | None) -> None:
        port = self.serialPortOrig
        try:
            if not select.select([port.fileno()], [], [], wait)[0]:
                return
            piece = port.read(max(1, port.in_waiting))
        except (serial.SerialException, OSError, TypeError, ValueError) as error:
            raise CanOperationError(str(error)) from error
        for byte in piece:
            if byte == _LINE_FEED:
                continue
            self._buffer.append(byte)
            if byte in _ENDS:
                self._lines.append(self._buffer.decode("ascii", errors="replace"))
                self._buffer.clear()
            elif len(self._buffer) > _LONGEST_LINE:
                self.malformed += 1
                self._buffer.clear()

    def _recv_internal(self, timeout: float | None) -> tuple[Message | None, bool]:
        line = self._read(timeout)
        if line is None:
            return None, False
        if line.endswith("\a"):
            # The adapter did not take a command or could not send a frame.
            self.refused += 1
            return None, False
        self._queue.put_nowait(line)
        try:
            return super()._recv_internal(0.0)
        except (ValueError, IndexError):
            self.malformed += 1
            return None, False

    def send(self, msg: Message, timeout: float | None = None) -> None:
        """Send a frame; how long that may take is the bus's own."""
        super().send(msg, self.serialPortOrig.write_timeout)


def _write_now(port: int, data: bytes) -> int:
    """Write what there is room for; return how many bytes that were."""
    try:
        return os.write(port, data)
    except BlockingIOError:
        return 0
