"""A worker does its jobs in order, looks when it is time to, and ends after the last."""

from __future__ import annotations

import threading
import time

from needle_bags.recording.worker import Job, WorkerThread, nothing

LONG = 3600.0


def test_a_job_ends_the_wait_for_what_is_due() -> None:
    begun, done = threading.Event(), threading.Event()

    def do(job: Job) -> float:
        job()
        begun.set()
        return time.monotonic() + LONG

    worker = WorkerThread(do, nothing)
    assert begun.wait(20.0)
    worker.put(done.set)
    assert done.wait(20.0)
    worker.finish()


def test_what_is_due_needs_no_job() -> None:
    looks: list[Job] = []
    over = threading.Event()

    def do(job: Job) -> float:
        looks.append(job)
        if len(looks) == 3:
            over.set()
        return time.monotonic() + (LONG if over.is_set() else 0.01)

    worker = WorkerThread(do, nothing)
    assert over.wait(20.0)
    assert set(looks) == {nothing}
    worker.finish()


def test_finish_waits_for_all_jobs_and_the_end() -> None:
    done: list[str] = []

    def do(job: Job) -> float:
        job()
        return time.monotonic() + LONG

    worker = WorkerThread(do, lambda: done.append("end"))
    names = [f"job {number}" for number in range(5)]
    for name in names:
        worker.put(lambda name=name: done.append(name))  # type: ignore[misc]
    worker.finish()
    assert done == [*names, "end"]
    assert not worker.waiting
    # Asked for again it has nothing to do.
    worker.finish()
    assert done[-2:] == [names[-1], "end"]
