"""The wish that a process ends, for a loop of its own that has something to finish first."""

from __future__ import annotations

import signal
from types import FrameType


class EndRequest:
    """SIGINT and SIGTERM as a flag.

    Made first thing in `main`, no signal is lost, one during start-up included. Handlers of rclpy's
    would shut its context down in the middle of what is under way, before last messages are out.

    Parameters
    ----------
    *more : signal.Signals
        Other signals that are taken in the same way.

    Attributes
    ----------
    wanted : bool
        Whether one has come.
    """

    def __init__(self, *more: signal.Signals) -> None:
        self.wanted = False
        for number in (signal.SIGINT, signal.SIGTERM, *more):
            signal.signal(number, self._take)

    def _take(self, _number: int, _frame: FrameType | None) -> None:
        self.wanted = True
