"""Serial CAN adapter that speaks the Lawicel protocol (slcan)."""

from __future__ import annotations

import errno
import os
import select
import time

import serial
from can import CanInitializationError, CanOperationError, Message
from can.interfaces.slcan import slcanBus

_LINE_ENDS = (0x0D, 0x07)
_LINE_FEED = 0x0A
_MAX_LINE = 64


class SlcanBus(slcanBus):
    """python-can's slcan bus with five changes.

    1. It reads the serial port in blocks: python-can reads byte by byte, which falls up to 0.8 s
       behind on a loaded machine.
    2. A write does not wait until the last bit has left the port, and waits at most
       `write_timeout` for free space, so that a stuck adapter cannot stall the control loop.
    3. It counts malformed lines; python-can raises an error.
    4. It accepts lines that end with CR and LF; python-can loses the frame after the LF.
    5. It locks the serial port against other programs.

    Parameters
    ----------
    channel : str
        Device file of the serial port.
    bitrate : int
        Bitrate of the CAN bus [bit/s].
    tty_baudrate : int
        Baud rate of the serial port [bit/s]; USB adapters ignore it.
    write_timeout : float
        Longest wait of a write for free space [s].

    Attributes
    ----------
    malformed : int
        Number of malformed lines.
    refused : int
        Number of commands and frames that the adapter refused.
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

    def set_up_channel(self) -> None:
        """Set the bitrate and open the channel."""
        self.set_bitrate(self._bitrate)

    def set_bitrate(self, bitrate: int, data_bitrate: int | None = None) -> None:
        """Set the bitrate and open the channel.

        Raises
        ------
        CanInitializationError
            If another program uses the port: frames of two programs would be mixed.
        """
        try:
            self.serialPortOrig.exclusive = True
        except serial.SerialException as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                raise CanInitializationError("another program uses it") from None
        # An earlier program may have left an unfinished line: end it.
        self._write("")
        super().set_bitrate(bitrate, data_bitrate)

    def open(self) -> None:
        """Open the channel once: python-can does it twice, and adapters refuse the second time."""
        if not self._channel_open:
            super().open()
            self._channel_open = True

    def close(self) -> None:
        """Close the channel."""
        self._channel_open = False
        super().close()

    def send(self, msg: Message, timeout: float | None = None) -> None:
        """Send a frame; `timeout` is ignored in favour of the write time-out of the bus."""
        super().send(msg, self.serialPortOrig.write_timeout)

    def _write(self, string: str) -> None:
        data = string.encode() + self.LINE_TERMINATOR
        deadline = time.monotonic() + self._write_timeout
        try:
            port = self.serialPortOrig.fileno()
            while data:
                data = data[_write_without_waiting(port, data) :]
                wait = max(0.0, deadline - time.monotonic())
                if data and not select.select([], [port], [], wait)[1]:
                    raise CanOperationError(f"accepted no data for {self._write_timeout:g} s")
        except (serial.SerialException, OSError, TypeError, ValueError) as error:
            # pyserial raises TypeError if another thread has closed the port.
            raise CanOperationError(str(error)) from error

    def _read(self, timeout: float | None) -> str | None:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._lines:
            wait = None if deadline is None else deadline - time.monotonic()
            if wait is not None and wait < 0.0:
                return None
            self._read_block(wait)
        return self._lines.pop(0)

    def _read_block(self, wait: float | None) -> None:
        port = self.serialPortOrig
        try:
            if not select.select([port.fileno()], [], [], wait)[0]:
                return
            block = port.read(max(1, port.in_waiting))
        except (serial.SerialException, OSError, TypeError, ValueError) as error:
            raise CanOperationError(str(error)) from error
        for byte in block:
            if byte == _LINE_FEED:
                continue
            self._buffer.append(byte)
            if byte in _LINE_ENDS:
                self._lines.append(self._buffer.decode("ascii", errors="replace"))
                self._buffer.clear()
            elif len(self._buffer) > _MAX_LINE:
                self.malformed += 1
                self._buffer.clear()

    def _recv_internal(self, timeout: float | None) -> tuple[Message | None, bool]:
        line = self._read(timeout)
        if line is None:
            return None, False
        if line.endswith("\a"):
            self.refused += 1
            return None, False
        self._queue.put_nowait(line)
        try:
            return super()._recv_internal(0.0)
        except (ValueError, IndexError):
            self.malformed += 1
            return None, False


def _write_without_waiting(port: int, data: bytes) -> int:
    """Write as many bytes as there is space for; return their number."""
    try:
        return os.write(port, data)
    except BlockingIOError:
        return 0
