"""Worker process for computations that would block this process, such as rendering."""

from __future__ import annotations

import ctypes
import multiprocessing
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from needle_core.process.shutdown import ENDING_SIGNALS

_PR_SET_PDEATHSIG = 1


def start_worker(prepare: Callable[..., None], *arguments: Any) -> ProcessPoolExecutor:
    """Start a process that executes submitted calls one after the other.

    It ends with its pool or with this process; signals alone do not end it.

    Parameters
    ----------
    prepare : callable
        Called first in the new process.
    arguments : tuple
        Its arguments.
    """
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, context, _begin, (prepare, *arguments))
    # The worker starts with these signals blocked: a signal to the process group must end only the
    # parent, which then ends the worker.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    pool.submit(int)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
    return pool


def _begin(prepare: Callable[..., None], *arguments: Any) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    prepare(*arguments)
