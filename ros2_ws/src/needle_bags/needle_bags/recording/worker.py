"""Worker that runs queued jobs in order, in a thread of its own."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Protocol

Job = Callable[[], None]
RunJob = Callable[[Job], None]


class Worker(Protocol):
    """Runs jobs one after the other."""

    @property
    def waiting(self) -> int:
        """Number of queued jobs."""

    def put(self, job: Job) -> None:
        """Queue a job."""

    def finish(self) -> None:
        """Run all queued jobs and the closing call, then return."""


class WorkerThread:
    """Worker with its own thread.

    Parameters
    ----------
    run_job : RunJob
        Runs the jobs.
    end : callable
        Called once, after the last job.
    """

    def __init__(self, run_job: RunJob, end: Job) -> None:
        self._run_job = run_job
        self._end = end
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="worker")
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of queued jobs."""
        return self._jobs.qsize()

    def put(self, job: Job) -> None:
        """Queue a job."""
        self._jobs.put(job)

    def finish(self) -> None:
        """Run all queued jobs and the closing call, then return."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._run_job(job)
        self._end()
