"""A worker takes a step when it is due or the bell rings, and none after the last."""

from __future__ import annotations

import threading
import time

from needle_bags.recording.worker import WorkerThread

LONG = 3600.0


def test_the_bell_ends_a_wait() -> None:
    begun, rung = threading.Event(), threading.Event()

    def step() -> float | None:
        if not begun.is_set():
            begun.set()
            return time.monotonic() + LONG
        rung.set()
        return None

    worker = WorkerThread(step)
    assert begun.wait(20.0)
    worker.ring()
    assert rung.wait(20.0)
    worker.finish()


def test_what_is_due_needs_no_bell() -> None:
    steps = iter((0.0, time.monotonic() + 0.01, None))
    over = threading.Event()

    def step() -> float | None:
        due = next(steps)
        if due is None:
            over.set()
        return due

    worker = WorkerThread(step)
    assert over.wait(20.0)
    worker.finish()


def test_finish_waits_for_the_last_step() -> None:
    ends, left = threading.Event(), list(range(5))

    def step() -> float | None:
        if not ends.is_set():
            return time.monotonic() + LONG
        left.pop()
        return time.monotonic() if left else None

    worker = WorkerThread(step)
    ends.set()
    worker.finish()
    assert not left
    # Asked for again it has nothing to do.
    worker.finish()
