"""Progress of the insertion on the terminal."""

from __future__ import annotations

import dataclasses
from typing import TextIO

from tqdm import tqdm

# Environment variable: file descriptor for the progress instead of stderr.
PROGRESS_FD = "NEEDLE_PROGRESS_FD"


@dataclasses.dataclass(frozen=True)
class Shown:
    """Insertion and final depth [m]; reason for waiting, empty while the needle advances."""

    insertion: float
    depth: float
    waits_because: str


class Progress:
    """A progress bar on a terminal, otherwise a line for every quarter.

    Parameters
    ----------
    stream : TextIO
        Output stream, usually stderr; kept as the attribute `stream`.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self._terminal = stream.isatty()
        self._bar: tqdm[None] | None = None
        self._shown_quarter = 0
        self._last_reason = ""

    def show(self, insertion: float, depth: float) -> None:
        """Show the insertion and the final depth [m]."""
        if depth <= 0.0:
            return
        if self._terminal:
            self._show_bar(insertion, depth)
            return
        quarter = int(4.0 * insertion / depth + 1e-6)
        if quarter > self._shown_quarter:
            self._shown_quarter = quarter
            print(f"{insertion * 1e3:5.1f} of {depth * 1e3:.1f} mm", file=self.stream, flush=True)

    def show_wait(self, reason: str) -> None:
        """Print each new reason for waiting once; an empty reason: no waiting."""
        if reason and reason != self._last_reason:
            self._remove_bar()
            print(f"waiting: {reason}", file=self.stream, flush=True)
        self._last_reason = reason

    def close(self, line: str) -> None:
        """Remove the bar and print a line, unless it is empty."""
        self._remove_bar()
        if line:
            print(line, file=self.stream, flush=True)

    def _remove_bar(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _show_bar(self, insertion: float, depth: float) -> None:
        if self._bar is None:
            tqdm.monitor_interval = 0  # no monitor thread
            self._bar = tqdm(
                total=round(depth * 1e3, 1),
                unit="mm",
                file=self.stream,
                leave=False,
                bar_format="inserted {bar} {n:.0f}/{total:.0f} mm, {elapsed}, {remaining} left",
            )
        self._bar.n = min(insertion * 1e3, float(self._bar.total))
        self._bar.refresh()
