"""The wish that a process ends: heard whatever it is doing, and over in a limited time."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType, TracebackType
from typing import Any, ClassVar

from needle_core.process.late_exit import LateExit

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# From the signal to the end [s]: a node that is still busy then ends there.
GRACE = 0.6
# For what is left when nothing is left to save: a DDS participant once hung in there.
TAKE_APART = 0.3
_SAME_WISH = 1.0
_Handler = Callable[[int, FrameType | None], None]
_DEFAULTS = (signal.SIG_DFL, signal.default_int_handler)


class EndRequest:
    """SIGINT, SIGTERM and SIGHUP as a flag, within a `with` block.

    No exception is raised and no context is shut down by a signal, so none can come in the middle
    of compiled code or before last messages are out; a second one changes nothing. A SIGHUP that is
    ignored, as below nohup, stays so. Time is limited where the process is the node's own
    (`needle_core.commands.executables` began it); in a test's process this is the flag alone.

    Parameters
    ----------
    grace : float, optional
        The process ends this long after the first signal even where nobody looks at the flag [s].
        None where something must be finished first, which then limits its time itself.
    code : int
        Exit code of such an end.

    Attributes
    ----------
    wanted : bool
        Whether a signal has come.
    """

    def __init__(self, grace: float | None = GRACE, code: int = 0) -> None:
        self.wanted = False
        self._before = _handle(self._take)
        self._exit: LateExit | None = None
        if LeaveAtOnce.began:
            LateExit.leave_signals_alone()
            if grace is not None:
                self._exit = LateExit(grace, code)
                self._exit.start_with_signal()

    def __enter__(self) -> EndRequest:
        return self

    def __exit__(
        self, _: type[BaseException] | None, __: BaseException | None, ___: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def leave(self, code: int) -> None:
        """Say that nothing is left to save: the process is gone soon, with this exit code."""
        self.wanted = True
        if self._exit is not None:
            self._exit.set_code(code)
        if LeaveAtOnce.began:
            LateExit(TAKE_APART, code).start()

    def _take(self, _number: int, _frame: FrameType | None) -> None:
        self.wanted = True


class LeaveAtOnce:
    """Ends the process with this exit code when a signal of `ENDING_SIGNALS` comes.

    For the time before anything has begun that must be ended in order: while modules are loaded,
    which may keep the interpreter for seconds where they come from a slow disk.

    Attributes
    ----------
    began : bool
        Whether this process began with one.
    """

    began: ClassVar[bool] = False

    def __init__(self, code: int) -> None:
        LeaveAtOnce.began = True
        self._code = code
        _handle(self._take)
        LateExit(TAKE_APART, code).start_with_signal()

    def _take(self, _number: int, _frame: FrameType | None) -> None:
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

    if LeaveAtOnce.began:
        LateExit.leave_signals_alone()
    before = {
        number: signal.signal(number, take)
        for number in ENDING_SIGNALS
        if (now := signal.getsignal(number)) in _DEFAULTS
        or isinstance(getattr(now, "__self__", None), LeaveAtOnce)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
