"""The CAN bus of emulated drives as a port: frames pass through an adapter at a pseudo-terminal."""

from __future__ import annotations

import select
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from needle_core.can_frame import CanFrame
from needle_sim.bus.pty_port import PtyPort

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
