"""A worker beside its owner: does one step after the other until there is none."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

Step = Callable[[], float | None]
"""Does one thing; returns when the next is due by itself, steady clock [s]; None: there is none."""


class Worker(Protocol):
    """Takes steps, each when it is due or when the bell rings."""

    def ring(self) -> None:
        """Have it take its next step at once."""

    def finish(self) -> None:
        """Ring, and return after the last step."""


class WorkerThread:
    """A worker in a thread of its own.

    Parameters
    ----------
    step : Step
        What it does.
    """

    def __init__(self, step: Step) -> None:
        self._step = step
        self._bell = threading.Event()
        self._thread = threading.Thread(target=self._run, name="worker")
        self._thread.start()

    def ring(self) -> None:
        """Have it take its next step at once."""
        self._bell.set()

    def finish(self) -> None:
        """Ring, and return after the last step."""
        self._bell.set()
        self._thread.join()

    def _run(self) -> None:
        while (due := self._step()) is not None:
            wait = due - time.monotonic()
            if wait > 0.0:
                self._bell.wait(wait)
            # Before the step: what rings from now on is seen by it, or by the next.
            self._bell.clear()
