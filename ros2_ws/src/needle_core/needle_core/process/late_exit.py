"""An end that comes at its time, whatever holds the process or its interpreter up."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import struct
from typing import Any, ClassVar

_MICROSECONDS = 1_000_000
_SIGEV_THREAD = 2


class _Event(ctypes.Structure):
    """C's `struct sigevent`, 64 bytes."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("unused", ctypes.c_int * 8),
    )


class _Request(ctypes.Structure):
    """C's `struct aiocb` on 64 bits, 168 bytes; what follows the event is the C library's own."""

    _fields_ = (
        ("file", ctypes.c_int),
        ("operation", ctypes.c_int),
        ("priority", ctypes.c_int),
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("event", _Event),
        ("rest", ctypes.c_char * 80),
    )


class LateExit:
    """Ends this process a given time after it was started, or after a signal.

    A thread of Python's own would wait for an interpreter lock that a call into compiled code may
    never give back. The C library reads asynchronously from a socket on which nothing comes, whose
    time limit is this time and at whose end it calls `_exit`. No step of it needs the interpreter.

    Parameters
    ----------
    seconds : float
        How long it takes [s, > 0].
    code : int
        Exit code.
    """

    # The C library looks at them for as long as the process lives.
    _kept: ClassVar[list[LateExit]] = []

    def __init__(self, seconds: float, code: int) -> None:
        self._kept.append(self)
        self._library = system_library()
        self._byte = ctypes.create_string_buffer(1)
        self._silent, self._other_end = socket.socketpair()
        whole, part = divmod(max(1, round(seconds * _MICROSECONDS)), _MICROSECONDS)
        self._silent.setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", whole, part)
        )
        self._end = self._request(self._silent.fileno(), code, self._library["_exit"])

    def start(self) -> None:
        """Begin to wait.

        Raises
        ------
        OSError
            If the system has no asynchronous reading to give.
        """
        self._read(self._end)

    def start_with_signal(self) -> None:
        """Begin to wait at the next signal that has a handler in Python; raises what `start` does.

        A handler runs when the interpreter gets round to it, behind whatever compiled code the main
        thread is in and behind other threads' turns. CPython's own part of it writes a byte into a
        pipe at once: the C library reads that, too, and begins the other reading when it is there.
        """
        pipe, wake = os.pipe()
        os.set_blocking(wake, False)
        then = self._library["aio_read"]
        self._signal = self._request(pipe, ctypes.addressof(self._end), then)
        self._read(self._signal)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)

    @staticmethod
    def leave_signals_alone() -> None:
        """Undo `start_with_signal` for signals that have not come yet."""
        signal.set_wakeup_fd(-1)

    def set_code(self, code: int) -> None:
        """Take another exit code."""
        self._end.event.value = code

    def _request(self, file: int, value: int, then: Any) -> _Request:
        """Return a read from a file after which `then(value)` is called."""
        event = _Event(
            value=value, notify=_SIGEV_THREAD, function=ctypes.cast(then, ctypes.c_void_p)
        )
        return _Request(file=file, buffer=ctypes.addressof(self._byte), length=1, event=event)

    def _read(self, request: _Request) -> None:
        if self._library.aio_read(ctypes.byref(request)):
            raise OSError(ctypes.get_errno(), "aio_read")


def system_library() -> ctypes.CDLL:
    """Return the library of asynchronous reading: its own before glibc 2.34."""
    found = ctypes.CDLL(None, use_errno=True)
    return found if hasattr(found, "aio_read") else ctypes.CDLL("librt.so.1", use_errno=True)
