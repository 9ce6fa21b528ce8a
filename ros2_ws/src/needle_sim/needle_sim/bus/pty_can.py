"""Serial CAN adapter at a pseudo-terminal: the CAN port of the emulated drives."""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import socket
import termios
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

from needle_core.can_frame import CanFrame
from needle_core.errors import UserError
from needle_sim.bus.slcan_adapter import SlcanAdapter

_READ_SIZE = 4096
# What the computer does not read is lost, as in an adapter with a full buffer.
_MOST_WAITING = 16384


class PtyPort:
    """The adapter that a computer opens as a serial port.

    Parameters
    ----------
    link : Path or None
        Gets a symbolic link to the pseudo-terminal while the adapter is plugged in.

    Raises
    ------
    UserError
        If something else is at `link`, or another emulator.
    """

    def __init__(self, link: Path | None = None) -> None:
        self._link = link
        self._master = self._slave = -1
        self._adapter = SlcanAdapter()
        self._waiting = b""
        self._lock: socket.socket | None = None
        self.plug_in()

    @property
    def filenos(self) -> list[int]:
        """File descriptors to wait for input at; none while unplugged."""
        return [self._master] if self._master >= 0 else []

    @property
    def path(self) -> str:
        """Path that the computer opens."""
        if self._link is not None:
            return str(self._link)
        return os.ttyname(self._slave) if self._slave >= 0 else ""

    def plug_in(self) -> None:
        """Appear, with the channel closed."""
        if self._master >= 0:
            return
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._adapter = SlcanAdapter()
        self._waiting = b""
        if self._link is not None:
            try:
                self._make_link(self._link)
            except UserError:
                self._link = None
                self.unplug()
                raise

    def unplug(self) -> None:
        """Disappear: whoever has the port open gets an error."""
        if self._master < 0:
            return
        if self._link is not None:
            with contextlib.suppress(OSError):
                if str(self._link.readlink()) == os.ttyname(self._slave):
                    self._link.unlink()
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    def receive(self) -> tuple[CanFrame, ...]:
        """Return the frames that the computer has sent; waits for nothing."""
        if self._master < 0:
            return ()
        try:
            data = os.read(self._master, _READ_SIZE)
        except OSError:
            return ()
        taken = self._adapter.feed(data)
        if taken.closed:
            # Whoever opens the channel, and closes it first, must not read what was meant for the
            # last one. When it is opened it may be read already.
            self._waiting = b""
            termios.tcflush(self._slave, termios.TCIFLUSH)
        self._write(taken.reply)
        return taken.frames

    def send(self, frames: list[CanFrame]) -> None:
        """Hand frames from the bus to the computer."""
        if self._master < 0:
            return
        data = b""
        for frame in frames:
            data += self._adapter.encode(frame)
        # A computer that does not read loses frames, as with a real adapter.
        self._write(data if len(self._waiting) + len(data) <= _MOST_WAITING else b"")

    def _make_link(self, link: Path) -> None:
        """Link to the pseudo-terminal; what a killed emulator has left there is replaced."""
        self._lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        name = hashlib.sha256(str(link.absolute()).encode()).hexdigest()
        try:
            # The kernel frees the name whatever becomes of this process.
            self._lock.bind(f"\0needle_pty_{name}")
        except OSError as error:
            raise UserError(f"{link}: another emulator is plugged in there") from error
        try:
            if link.is_symlink() and str(link.readlink()).startswith("/dev/pts/"):
                link.unlink()
            link.symlink_to(os.ttyname(self._slave))
        except OSError as error:
            raise UserError(f"cannot make the link {link}: {error.strerror}") from error

    def _write(self, data: bytes) -> None:
        self._waiting += data
        while self._waiting:
            try:
                written = os.write(self._master, self._waiting)
            except OSError:
                return
            self._waiting = self._waiting[written:]


_LOOK = 0.05


class PtyCan:
    """A port that reads the adapter in a thread of its own.

    Parameters
    ----------
    link : Path or None
        Gets a symbolic link to the pseudo-terminal.

    Raises
    ------
    UserError
        If something else is at `link`, or another emulator.
    """

    def __init__(self, link: Path | None) -> None:
        self._pty = PtyPort(link)
        self._lock = threading.Lock()
        self._is_closed = False
        self._thread: threading.Thread | None = None

    @property
    def path(self) -> str:
        """Path that the computer opens."""
        return self._pty.path

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Begin to read."""
        self._thread = threading.Thread(target=self.read, args=(arrive,), daemon=True)
        self._thread.start()

    def read(self, arrive: Callable[[Any], None]) -> None:
        """Hand on what the computer sends, until the adapter is closed."""
        while not self._is_closed:
            with self._lock:
                waited_for = self._pty.filenos
            try:
                select.select(waited_for, [], [], _LOOK)
            except OSError:
                # Unplugged meanwhile.
                continue
            with self._lock:
                frames = self._pty.receive()
            if frames:
                arrive(frames)

    def send(self, batch: tuple[CanFrame, ...]) -> None:
        """Hand frames to the computer."""
        with self._lock:
            self._pty.send(list(batch))

    def plug(self, *, plugged_in: bool) -> None:
        """Let the adapter appear or disappear."""
        with self._lock:
            if plugged_in:
                self._pty.plug_in()
            else:
                self._pty.unplug()

    def close(self) -> None:
        """Take the adapter away."""
        self._is_closed = True
        if self._thread is not None:
            self._thread.join()
        self._pty.unplug()
