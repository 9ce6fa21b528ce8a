"""A process that works for this one, beside it: for what takes long, as images do."""

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
    """Start a process that works off what is submitted, one after the other.

    It ends when it is told to or when this process ends; signals alone do not end it.

    Parameters
    ----------
    prepare : callable
        Called first, in that process.
    arguments : tuple
        Its arguments.
    """
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, context, _begin, (prepare, *arguments))
    # The process has from its first moment on what its parent blocks: signals to the whole group,
    # by which its parent ends in order, and then ends it.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
    pool.submit(int)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING_SIGNALS)
    return pool


def _begin(prepare: Callable[..., None], *arguments: Any) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    prepare(*arguments)
