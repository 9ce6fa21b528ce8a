"""Worker process for computations that would block this process, such as rendering."""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.component import PortChange

_CLOSE_TIMEOUT = 2.0
"""Time for the work that is queued when the port closes [s]."""
_END = object()


class WorkerProcess:
    """Port to a process that applies a function to each item of a batch, one after the other.

    Each result arrives as a batch of one item. If the process ends by itself, because of an
    exception for example, the port is lost when the next item is due, and drops what is sent.

    The process has a session of its own, so that signals to this process' group do not reach it.
    It ends with its input: when this process closes the port, ends or is killed.

    Parameters
    ----------
    make : callable
        Called in the new process; returns the function. Must be importable.
    arguments : tuple
        Its arguments.
    """

    def __init__(self, make: Callable[..., Callable[[Any], Any]], *arguments: Any) -> None:
        self._items: queue.SimpleQueue[Any] = queue.SimpleQueue()
        # By its file: `python -m` would look for modules in the working directory first.
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self._write((make, arguments))

    def open(self, arrive: Callable[[tuple[Any] | PortChange], None]) -> None:
        """Pass results to `arrive` from now on, from a thread."""
        self._thread = threading.Thread(target=self._exchange, args=(arrive,), daemon=True)
        self._thread.start()

    def send(self, batch: tuple[Any, ...]) -> None:
        """Queue items."""
        for item in batch:
            self._items.put(item)

    def close(self) -> None:
        """Wait a short time until the queued items are done, then kill the process."""
        self._items.put(_END)
        self._thread.join(_CLOSE_TIMEOUT)
        self._process.kill()
        self._thread.join()

    def _write(self, item: Any) -> None:
        assert self._process.stdin is not None
        pickle.dump(item, self._process.stdin)
        self._process.stdin.flush()

    def _exchange(self, arrive: Callable[[tuple[Any] | PortChange], None]) -> None:
        """Write an item and read its result in turn, so that neither process blocks the other."""
        try:
            with self._process as process:
                assert process.stdout is not None
                for item in iter(self._items.get, _END):
                    self._write(item)
                    arrive((pickle.load(process.stdout),))
        except (BrokenPipeError, EOFError, pickle.UnpicklingError):
            arrive(PortChange("the worker process has ended"))


def _work() -> int:
    """Apply the function to the items of the standard input, until it ends."""
    items, results = os.fdopen(0, "rb"), sys.stdout.buffer
    # Output of libraries must not be mixed with the results.
    with contextlib.redirect_stdout(sys.stderr):
        make, arguments = pickle.load(items)
        function = make(*arguments)
        while items.peek(1):
            pickle.dump(function(pickle.load(items)), results)
            results.flush()
    return EXIT_DONE


if __name__ == "__main__":
    # Nothing is left to clean up: skip the slow shutdown of the interpreter.
    os._exit(run_command(_work))
