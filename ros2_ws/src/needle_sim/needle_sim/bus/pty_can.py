"""Serial CAN adapter at a pseudo-terminal: the CAN port of the emulated drives."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from needle_core.can_frame import CanFrame
from needle_core.errors import UserError
from needle_core.process.ros_domain import Claim
from needle_sim.bus.slcan_adapter import SlcanAdapter

_READ_SIZE = 4096
# Unread output beyond this size is lost, as in an adapter with a full buffer [bytes].
_MAX_PENDING = 16384
_WAKE_UP_PERIOD = 0.05  # [s]


class PtyCan:
    """Port of a component: a pseudo-terminal that a computer opens as a serial CAN adapter.

    `open` starts a thread that reads it; without one, call `receive`.

    Parameters
    ----------
    link : Path or None
        Symbolic link to the pseudo-terminal, which exists while the adapter is plugged in.

    Raises
    ------
    UserError
        If another file or another emulator is at `link`.
    """

    def __init__(self, link: Path | None = None) -> None:
        self._link = link
        self._master = self._slave = -1
        self._claim: Claim | None = None
        self._lock = threading.Lock()
        self._is_closed = False
        self._thread: threading.Thread | None = None
        self.plug(plugged_in=True)

    @property
    def path(self) -> str:
        """Path that the computer opens."""
        if self._link is not None:
            return str(self._link)
        return os.ttyname(self._slave) if self._slave >= 0 else ""

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Start the reader thread."""
        self._thread = threading.Thread(target=self.read, args=(arrive,), daemon=True)
        self._thread.start()

    def read(self, arrive: Callable[[Any], None]) -> None:
        """Deliver frames from the computer until the port is closed."""
        while not self._is_closed:
            self.wait(_WAKE_UP_PERIOD)
            if frames := self.receive():
                arrive(frames)

    def wait(self, timeout: float) -> None:
        """Wait for input, at most for `timeout` [s]."""
        inputs = [self._master] if self._master >= 0 else []
        # The adapter may be unplugged meanwhile.
        with contextlib.suppress(OSError):
            select.select(inputs, [], [], timeout)

    def receive(self) -> tuple[CanFrame, ...]:
        """Return the frames that the computer has sent; never block."""
        with self._lock:
            try:
                data = os.read(self._master, _READ_SIZE)
            except OSError:
                return ()
            result = self._adapter.feed(data)
            if result.closed:
                # A program first closes the channel, then opens it. Discard output for the
                # previous program at the close: at the opening, the new one may have read it.
                self._pending = b""
                termios.tcflush(self._slave, termios.TCIFLUSH)
            self._write(result.reply)
            return result.frames

    def send(self, batch: Sequence[CanFrame]) -> None:
        """Send frames to the computer; they are lost if it does not read."""
        with self._lock:
            if self._master >= 0:
                data = b"".join(self._adapter.encode(frame) for frame in batch)
                self._write(data if len(self._pending) + len(data) <= _MAX_PENDING else b"")

    def plug(self, *, plugged_in: bool) -> None:
        """Plug the adapter in, with the channel closed, or unplug it.

        A program that has it open then gets an error.
        """
        with self._lock:
            if plugged_in and self._master < 0:
                self._plug_in()
            elif not plugged_in and self._master >= 0:
                self._unplug()

    def close(self) -> None:
        """Stop the reader thread and remove the adapter."""
        self._is_closed = True
        if self._thread is not None:
            self._thread.join()
        self.plug(plugged_in=False)

    def _plug_in(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._adapter = SlcanAdapter()
        self._pending = b""
        if self._link is not None:
            try:
                self._make_link(self._link)
            except UserError:
                self._link = None
                self._unplug()
                raise

    def _unplug(self) -> None:
        if self._link is not None:
            with contextlib.suppress(OSError):
                if str(self._link.readlink()) == os.ttyname(self._slave):
                    self._link.unlink()
        if self._claim is not None:
            self._claim.release()
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    def _make_link(self, link: Path) -> None:
        """Link to the pseudo-terminal; replace the link of a killed emulator."""
        try:
            self._claim = Claim(f"needle_pty_{link.absolute()}", "drive_emulator")
        except UserError as error:
            raise UserError(f"{link}: another emulator uses this link") from error
        try:
            if link.is_symlink() and str(link.readlink()).startswith("/dev/pts/"):
                link.unlink()
            link.symlink_to(os.ttyname(self._slave))
        except OSError as error:
            raise UserError(f"cannot make the link {link}: {error.strerror}") from error

    def _write(self, data: bytes) -> None:
        self._pending += data
        while self._pending:
            try:
                written = os.write(self._master, self._pending)
            except OSError:
                return
            self._pending = self._pending[written:]
