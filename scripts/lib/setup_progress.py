"""Progress of scripts/setup on the terminal."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType


def say(text: str) -> None:
    """Print one line of progress."""
    print(f"setup: {text}", file=sys.stderr, flush=True)


# How often progress is shown on a terminal, and where each time is a line of its own [s].
TICK = 1.0
TICK_OF_LINES = 30.0


class Phase:
    """One line of progress, updated in place on a terminal, within a `with` block."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._start = time.monotonic()
        self._live = sys.stderr.isatty()
        self._detail = ""
        self._over = threading.Event()
        self._ticks = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> Phase:
        self._print(" ...", "" if self._live else "\n")
        self._ticks.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None
    ) -> None:
        self._over.set()
        self._ticks.join()
        if kind is None:
            self._print(f": {self._seconds()} s", "\n")
        elif self._live:
            # The line stays as it is, before something else is printed.
            print(file=sys.stderr)

    def update(self, detail: str) -> None:
        """Show how far it is."""
        self._detail = detail
        if self._live:
            self._show()

    def _tick(self) -> None:
        """Show that it goes on while pip and compilers are silent, for minutes on slow machines."""
        while not self._over.wait(TICK if self._live else TICK_OF_LINES):
            self._show()

    def _show(self) -> None:
        self._print(
            " ... " + ", ".join(filter(None, (self._detail, f"{self._seconds()} s"))),
            "" if self._live else "\n",
        )

    def _seconds(self) -> str:
        return f"{time.monotonic() - self._start:.0f}"

    def _print(self, rest: str, end: str = "") -> None:
        start = "\r\033[K" if self._live else ""
        print(f"{start}setup: {self._text}{rest}", end=end, file=sys.stderr, flush=True)
