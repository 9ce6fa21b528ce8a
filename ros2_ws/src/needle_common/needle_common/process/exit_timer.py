"""An end that comes at its time, whatever holds the process up."""

from __future__ import annotations

import ctypes

_CLOCK_MONOTONIC = 1
SIGEV_THREAD = 2
_NANOSECONDS = 1_000_000_000


class SignalEvent(ctypes.Structure):
    """C's `struct sigevent`, 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("unused", ctypes.c_int * 8),
    )


class _Times(ctypes.Structure):
    """C's `struct itimerspec`: period and first expiry."""

    _fields_ = (("period", ctypes.c_long * 2), ("first", ctypes.c_long * 2))


class ExitTimer:
    """Ends this process with an exit code after a time.

    It is the C library's timer, and what it calls is `_exit`: a thread of Python's own would wait
    for an interpreter lock that a call into compiled code may never give back.
    """

    def __init__(self) -> None:
        self._library = system_library()
        self._timer: ctypes.c_void_p | None = None

    def start(self, seconds: float, code: int) -> None:
        """End the process in this time [s, > 0]; a time that ran before no longer counts.

        Raises
        ------
        OSError
            If the system has no timer to give.
        """
        self.stop()
        event = SignalEvent(
            value=code,
            notify=SIGEV_THREAD,
            function=ctypes.cast(self._library["_exit"], ctypes.c_void_p),
        )
        timer = ctypes.c_void_p()
        if self._library.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
            raise OSError(ctypes.get_errno(), "timer_create")
        self._timer = timer
        times = _Times()
        times.first[:] = divmod(max(1, round(seconds * _NANOSECONDS)), _NANOSECONDS)
        self._library.timer_settime(timer, 0, ctypes.byref(times), None)

    def stop(self) -> None:
        """Let the process live on."""
        if self._timer is not None:
            self._library.timer_delete(self._timer)
            self._timer = None


def system_library() -> ctypes.CDLL:
    """Return the library of timers and asynchronous reading: its own before glibc 2.34."""
    found = ctypes.CDLL(None, use_errno=True)
    return found if hasattr(found, "timer_create") else ctypes.CDLL("librt.so.1", use_errno=True)
