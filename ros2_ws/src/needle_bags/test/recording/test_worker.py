"""Worker: jobs in order, and an end after the last job."""

from __future__ import annotations

from needle_bags.recording.worker import Job, WorkerThread


def test_jobs_run_in_order_before_the_end() -> None:
    done: list[str] = []

    def do(job: Job) -> None:
        job()

    worker = WorkerThread(do, lambda: done.append("end"))
    names = [f"job {number}" for number in range(5)]
    for name in names:
        worker.put(lambda name=name: done.append(name))  # type: ignore[misc]
    worker.finish()
    assert done == [*names, "end"]
    assert not worker.waiting
    # A second call has no effect.
    worker.finish()
    assert done == [*names, "end"]
