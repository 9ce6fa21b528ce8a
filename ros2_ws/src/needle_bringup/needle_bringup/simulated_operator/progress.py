"""Progress of the insertion, shown to the person at the terminal."""

from __future__ import annotations

import dataclasses
from typing import TextIO

from tqdm import tqdm

# Environment variable: number of an open file that takes the progress instead of stderr.
PROGRESS_FD = "NEEDLE_PROGRESS_FD"


@dataclasses.dataclass(frozen=True)
class Shown:
    """Insertion and depth of the needle [m], and why it does not go on; empty: it does."""

    insertion: float
    depth: float
    waits_because: str


class Progress:
    """A bar on a terminal, a line for every quarter elsewhere.

    Parameters
    ----------
    stream : TextIO
        Where to show it, usually stderr; kept as the attribute `stream`.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self._terminal = stream.isatty()
        self._bar: tqdm[None] | None = None
        self._shown_quarter = 0
        self._told_wait = ""

    def show(self, insertion: float, depth: float) -> None:
        """Show that the needle is `insertion` of `depth` in [m]."""
        if depth <= 0.0:
            return
        if self._terminal:
            self._show_bar(insertion, depth)
            return
        quarter = int(4.0 * insertion / depth + 1e-6)
        if quarter > self._shown_quarter:
            self._shown_quarter = quarter
            print(f"{insertion * 1e3:5.1f} of {depth * 1e3:.1f} mm", file=self.stream, flush=True)

    def tell_wait(self, reason: str) -> None:
        """Say once why the needle does not go on; an empty reason: it does."""
        if reason and reason != self._told_wait:
            self._take_bar_away()
            print(f"waiting: {reason}", file=self.stream, flush=True)
        self._told_wait = reason

    def close(self, line: str) -> None:
        """Take the bar away and leave one line, unless it is empty."""
        self._take_bar_away()
        if line:
            print(line, file=self.stream, flush=True)

    def _take_bar_away(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _show_bar(self, insertion: float, depth: float) -> None:
        if self._bar is None:
            tqdm.monitor_interval = 0  # its thread would outlive the bar
            self._bar = tqdm(
                total=round(depth * 1e3, 1),
                unit="mm",
                file=self.stream,
                leave=False,
                bar_format="inserted {bar} {n:.0f}/{total:.0f} mm, {elapsed}, {remaining} left",
            )
        self._bar.n = min(insertion * 1e3, float(self._bar.total))
        self._bar.refresh()
