"""Non-blocking keyboard input from the terminal."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import tty
from typing import Any, Final

PAUSE: Final = " "
FASTER: Final = "\x1b[A"
SLOWER: Final = "\x1b[B"
FORWARD: Final = "\x1b[C"
BACK: Final = "\x1b[D"
# A terminal sends an arrow key as three characters, in application mode with O.
_KEY: Final = re.compile(r"\x1b[\[O][A-D]|.", re.DOTALL)


def keys_in(text: str) -> list[str]:
    """Return the keys in the characters of a terminal."""
    return [key.replace("\x1bO", "\x1b[") for key in _KEY.findall(text)]


class Keys:
    """Keys pressed in the terminal; none without a terminal."""

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

    def pressed(self) -> list[str]:
        """Return the keys pressed since the last call."""
        if self._file is None or not select.select([self._file], [], [], 0.0)[0]:
            return []
        return keys_in(os.read(self._file, 256).decode(errors="replace"))
