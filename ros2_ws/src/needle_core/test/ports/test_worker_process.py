"""Worker process: its results, and its end by an error, a close and the end of its parent."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from operator import methodcaller
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

from needle_core.component import PortChange
from needle_core.ports import worker_process as module
from needle_core.ports.worker_process import WorkerProcess

TIMEOUT = 60.0  # [s]
ENDED = PortChange("the worker process has ended")


class Calls:
    """Worker that calls its items, and the queue of what arrives."""

    def __init__(self) -> None:
        self.port = WorkerProcess(methodcaller, "__call__")
        self.arrived: SimpleQueue[Any] = SimpleQueue()
        self.port.open(self.arrived.put)

    def next(self) -> Any:
        return self.arrived.get(timeout=TIMEOUT)


@pytest.fixture
def calls() -> Iterator[Calls]:
    made = Calls()
    yield made
    made.port.close()


def test_results_of_any_size_arrive_in_order_and_prints_are_none(calls: Calls) -> None:
    size = 1 << 22
    calls.port.send((partial(print, "printed"), partial(bytes.upper, b"a" * size), os.getpgrp))
    assert calls.next() == (None,)
    assert calls.next() == (b"A" * size,)
    # A signal to the group of this process does not reach the worker.
    assert calls.next() != (os.getpgrp(),)


@pytest.mark.parametrize(
    "item",
    [
        partial(int, "x"),
        partial(exec, "import os; os._exit(0)"),
        partial(exec, "import os, pickle; os.write(1, pickle.dumps('cut' * 9)[:20]); os._exit(0)"),
    ],
)
def test_the_end_of_the_process_loses_the_port(calls: Calls, item: partial[Any]) -> None:
    calls.port.send((item, os.getpid))
    assert calls.next() == ENDED
    calls.port.send((os.getpid,))
    calls.port.close()
    assert calls.arrived.empty()


def test_a_close_waits_for_the_queued_items(
    capfd: pytest.CaptureFixture[str], calls: Calls, tmp_path: Path
) -> None:
    files = [tmp_path / name for name in "ab"]
    calls.port.send(tuple(file.touch for file in files))
    calls.port.close()
    assert all(file.exists() for file in files)
    assert [calls.next(), calls.next()] == [(None,)] * 2
    assert calls.arrived.empty()
    assert capfd.readouterr().err == ""


def test_a_close_kills_a_process_that_hangs(calls: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CLOSE_TIMEOUT", 0.01)
    calls.port.send((os.getpid, signal.pause))
    (process,) = calls.next()
    calls.port.close()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


PARENT = """
import os, sys
from operator import methodcaller
from needle_core.ports.worker_process import WorkerProcess
worker = WorkerProcess(methodcaller, "__call__")
worker.open(lambda batch: print(*batch, flush=True))
worker.send((os.getpid,))
sys.stdin.read()
"""


@pytest.mark.parametrize("is_killed", [True, False])
def test_the_process_ends_with_its_parent(is_killed: bool) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as parent:
        assert parent.stdout is not None
        process = os.pidfd_open(int(parent.stdout.readline()))
        if is_killed:
            parent.kill()
        parent.communicate(timeout=TIMEOUT)
        # The descriptor of a process becomes readable when it ends.
        assert select.select([process], [], [], TIMEOUT)[0] == [process]
        os.close(process)
