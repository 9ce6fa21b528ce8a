"""Keys pressed in the terminal, without waiting for them."""

from __future__ import annotations

import select
import sys
import termios
import tty
from typing import Any


class Keys:
    """The keys pressed in a terminal; none where there is no terminal."""

    def __init__(self) -> None:
        self._file = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else None
        self._before: list[Any] = []

    def __enter__(self) -> Keys:
        if self._file is not None:
            self._before = termios.tcgetattr(self._file)
            tty.setcbreak(self._file)
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """Return the key pressed since the last call, or an empty text."""
        if self._file is None or not select.select([self._file], [], [], 0.0)[0]:
            return ""
        return sys.stdin.read(1)
