"""A worker outlives signals to the group, knows what it was prepared with, and does its work."""

from __future__ import annotations

import os
import signal
from typing import ClassVar

import pytest

from needle_core.process.end_request import ENDING_SIGNALS
from needle_core.process.worker import start_worker


class Desk:
    """What is prepared in the worker."""

    lies_there: ClassVar[str] = ""

    @staticmethod
    def put(what: str) -> None:
        Desk.lies_there = what

    @staticmethod
    def tell() -> tuple[int, str]:
        return os.getpid(), Desk.lies_there


@pytest.mark.parametrize("number", ENDING_SIGNALS)
def test_a_signal_ends_no_worker_and_stays_one_for_its_parent(number: signal.Signals) -> None:
    with start_worker(Desk.put, "images") as worker:
        process, there = worker.submit(Desk.tell).result()
        assert there == "images"
        assert process != os.getpid()
        os.kill(process, number)
        assert worker.submit(Desk.tell).result() == (process, "images")
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(ENDING_SIGNALS)
    assert Desk.lies_there == ""
