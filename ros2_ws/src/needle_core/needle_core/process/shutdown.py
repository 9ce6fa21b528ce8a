"""Shutdown of a process by signals."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType, TracebackType
from typing import Any

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_REPEAT_WINDOW = 1.0
_Handler = Callable[[int, FrameType | None], None]
_DEFAULTS = (signal.SIG_DFL, signal.default_int_handler)


class ShutdownFlag:
    """Flag that SIGINT, SIGTERM and SIGHUP set within a `with` block.

    A signal neither raises an exception nor shuts the ROS context down, so that compiled code and
    the last messages complete; further signals have no effect. An ignored SIGHUP (nohup) stays
    ignored.

    Attributes
    ----------
    requested : bool
        Whether a signal has arrived.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before = _handle(self._on_signal)

    def __enter__(self) -> ShutdownFlag:
        return self

    def __exit__(
        self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True


class ExitOnSignal:
    """Handler that ends the process at once when a signal of `ENDING_SIGNALS` arrives.

    It is used while modules are loaded, when there is nothing to clean up.
    """

    def __init__(self, code: int) -> None:
        self._code = code
        _handle(self)

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        """End the process."""
        os._exit(self._code)


def _handle(handler: _Handler) -> dict[signal.Signals, Any]:
    """Set the handler, even for a SIGINT ignored by a background job; return the old handlers."""
    return {
        number: signal.signal(number, handler)
        for number in ENDING_SIGNALS
        if not (number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN)
    }


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt within a `with` block when a signal of `ENDING_SIGNALS` arrives.

    Further signals within a second are ignored, because a terminal and a script may both forward
    the same signal during the clean-up. Custom handlers that were set before are kept.
    """
    raised = -math.inf

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal raised
        if time.monotonic() - raised > _REPEAT_WINDOW:
            raised = time.monotonic()
            raise KeyboardInterrupt

    before = {
        number: signal.signal(number, interrupt)
        for number in ENDING_SIGNALS
        if (now := signal.getsignal(number)) in _DEFAULTS or isinstance(now, ExitOnSignal)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
