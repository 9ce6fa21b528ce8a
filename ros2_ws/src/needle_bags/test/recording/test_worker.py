"""Worker: jobs in order, periodic wake-ups, and an end after the last job."""

from __future__ import annotations

import queue

from needle_bags.recording.worker import Job, WorkerThread, no_op


def test_jobs_run_in_order_with_periodic_wake_ups() -> None:
    done: list[str] = []
    looked: queue.SimpleQueue[Job] = queue.SimpleQueue()

    def do(job: Job) -> float:
        job()
        if job is no_op:
            looked.put(job)
        return 0.0  # request the next wake-up immediately

    worker = WorkerThread(do, lambda: done.append("end"))
    for _ in range(3):
        assert looked.get(timeout=20.0) is no_op
    names = [f"job {number}" for number in range(5)]
    for name in names:
        worker.put(lambda name=name: done.append(name))  # type: ignore[misc]
    worker.finish()
    assert done == [*names, "end"]
    assert not worker.waiting
    # A second call has no effect.
    worker.finish()
    assert done[-2:] == [names[-1], "end"]


def test_a_job_ends_the_wait_for_the_next_wake_up() -> None:
    done: queue.SimpleQueue[int] = queue.SimpleQueue()

    def do(job: Job) -> float:
        job()
        return float("1e9")

    worker = WorkerThread(do, no_op)
    worker.put(lambda: done.put(1))
    assert done.get(timeout=20.0) == 1
    worker.finish()
