"""Progress of the insertion on the terminal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TextIO

from tqdm import tqdm

from needle_core.status_messages import ControllerStatus

# Environment variable: file descriptor for the progress instead of stderr.
PROGRESS_FD = "NEEDLE_PROGRESS_FD"


class Progress:
    """Progress bar on a terminal, otherwise a line for every quarter of the insertion.

    It is also the port of `SimulatedOperator` for its progress.

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

    def open(self, arrive: Callable[[Any], None]) -> None:
        """Do nothing: this port has no events."""

    def send(self, batch: tuple[ControllerStatus, ...]) -> None:
        """Show the statuses of a batch."""
        for status in batch:
            self.show(status)

    def show(self, status: ControllerStatus) -> None:
        """Show the insertion, and print each new reason for waiting once."""
        waits = status.state == "WAITING_FOR_TIP"
        if (waits or status.state in ("STEERING", "DONE")) and status.depth_m:
            self._show_insertion(status.insertion_m, status.depth_m)
        reason = status.reason if waits else ""
        if reason and reason != self._last_reason:
            self._remove_bar()
            print(f"waiting: {reason}", file=self.stream, flush=True)
        self._last_reason = reason

    def _show_insertion(self, insertion: float, depth: float) -> None:
        if self._terminal:
            self._show_bar(insertion, depth)
            return
        quarter = int(4.0 * insertion / depth + 1e-6)
        if quarter > self._shown_quarter:
            self._shown_quarter = quarter
            print(f"{insertion * 1e3:5.1f} of {depth * 1e3:.1f} mm", file=self.stream, flush=True)

    def close(self, line: str = "") -> None:
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
