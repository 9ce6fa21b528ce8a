"""A worker beside its owner: does one job after the other, in the order in which they came."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Protocol

Job = Callable[[], None]
Do = Callable[[Job], float]
"""Does a job; returns when it wants to be called at the latest, be it for `nothing`, steady clock
[s]."""


def nothing() -> None:
    """Do nothing: the job of who is called for the time alone."""


class Worker(Protocol):
    """Hands jobs on, each as soon as the one before is done."""

    @property
    def waiting(self) -> int:
        """Jobs that have not been taken yet."""

    def put(self, job: Job) -> None:
        """Queue a job."""

    def finish(self) -> None:
        """Return when all jobs, and what comes at the end, are done."""


class WorkerThread:
    """A worker in a thread of its own.

    Parameters
    ----------
    do : Do
        Does its jobs.
    end : callable
        Called once, after the last.
    """

    def __init__(self, do: Do, end: Callable[[], None]) -> None:
        self._do = do
        self._end = end
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="worker")
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Jobs that have not been taken yet."""
        return self._jobs.qsize()

    def put(self, job: Job) -> None:
        """Queue a job."""
        self._jobs.put(job)

    def finish(self) -> None:
        """Return when all jobs, and what comes at the end, are done."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        due = self._do(nothing)
        while True:
            try:
                job = self._jobs.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                job = nothing
            if job is None:
                self._end()
                return
            due = self._do(job)
