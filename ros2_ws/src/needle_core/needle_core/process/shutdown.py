"""The wish that a process ends, heard whatever it is doing."""

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
_SAME_WISH = 1.0
_Handler = Callable[[int, FrameType | None], None]
_DEFAULTS = (signal.SIG_DFL, signal.default_int_handler)


class ShutdownFlag:
    """SIGINT, SIGTERM and SIGHUP as a flag, within a `with` block.

    No exception is raised and no context is shut down by a signal, so none can come in the middle
    of compiled code or before last messages are out; a second one changes nothing. A SIGHUP that is
    ignored, as below nohup, stays so.

    Attributes
    ----------
    requested : bool
        Whether a signal has come.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before = _handle(self._take)

    def __enter__(self) -> ShutdownFlag:
        return self

    def __exit__(
        self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _take(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True


class ExitOnSignal:
    """Handler that ends the process with this exit code when a signal of `ENDING_SIGNALS` comes.

    For the time while modules are loaded: nothing has begun that must be ended in order.
    """

    def __init__(self, code: int) -> None:
        self._code = code
        _handle(self)

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        """Take a signal."""
        os._exit(self._code)


def _handle(take: _Handler) -> dict[signal.Signals, Any]:
    """Take the signals, also a SIGINT that a shell's background ignores; return who did before."""
    return {
        number: signal.signal(number, take)
        for number in ENDING_SIGNALS
        if not (number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN)
    }


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let a signal of `ENDING_SIGNALS` raise KeyboardInterrupt within a `with` block.

    Others within a second are the same wish (a terminal and a script both pass it on) and do not
    disturb the cleaning up. Handlers that somebody has set before stay.
    """
    raised = -math.inf

    def take(_number: int, _frame: FrameType | None) -> None:
        nonlocal raised
        if time.monotonic() - raised > _SAME_WISH:
            raised = time.monotonic()
            raise KeyboardInterrupt

    before = {
        number: signal.signal(number, take)
        for number in ENDING_SIGNALS
        if (now := signal.getsignal(number)) in _DEFAULTS or isinstance(now, ExitOnSignal)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
