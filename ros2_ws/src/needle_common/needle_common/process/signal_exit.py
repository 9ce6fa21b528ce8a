"""An end at its time after a signal, whatever holds the interpreter up."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import struct
from typing import Any, ClassVar

from needle_common.process.exit_timer import SIGEV_THREAD, SignalEvent, system_library

_MICROSECONDS = 1_000_000


class _Request(ctypes.Structure):
    """C's `struct aiocb` on 64 bits, 168 bytes; what follows the event is the C library's own."""

    _fields_ = (
        ("file", ctypes.c_int),
        ("operation", ctypes.c_int),
        ("priority", ctypes.c_int),
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("event", SignalEvent),
        ("rest", ctypes.c_char * 80),
    )


class SignalExit:
    """Ends this process a given time after a signal that has a handler in Python.

    A handler runs when the interpreter gets round to it, behind whatever compiled code the main
    thread is in and behind other threads' turns. CPython's own part of it writes a byte into a pipe
    at once. The C library reads that pipe asynchronously and, when the byte is there, calls another
    such read: of a socket on which nothing comes, whose time limit is the grace and at whose end
    it calls `_exit`. No step of it needs the interpreter.

    Parameters
    ----------
    seconds : float
        From the signal to the end [s, > 0].
    code : int
        Exit code.

    Raises
    ------
    OSError
        If the system has no asynchronous reading to give.
    """

    # The C library looks at them for as long as the process lives.
    _kept: ClassVar[list[SignalExit]] = []

    def __init__(self, seconds: float, code: int) -> None:
        self._kept.append(self)
        library = system_library()
        self._byte = ctypes.create_string_buffer(1)
        self._silent, self._other_end = socket.socketpair()
        whole, part = divmod(max(1, round(seconds * _MICROSECONDS)), _MICROSECONDS)
        self._silent.setsockopt(
            socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", whole, part)
        )
        self._grace = self._request(self._silent.fileno(), code, library["_exit"])
        pipe, wake = os.pipe()
        os.set_blocking(wake, False)
        self._signal = self._request(pipe, ctypes.addressof(self._grace), library["aio_read"])
        if library.aio_read(ctypes.byref(self._signal)):
            raise OSError(ctypes.get_errno(), "aio_read")
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)

    def set_code(self, code: int) -> None:
        """Take another exit code."""
        self._grace.event.value = code

    def _request(self, file: int, value: int, then: Any) -> _Request:
        """Return a read from a file after which `then(value)` is called."""
        event = SignalEvent(
            value=value, notify=SIGEV_THREAD, function=ctypes.cast(then, ctypes.c_void_p)
        )
        return _Request(file=file, buffer=ctypes.addressof(self._byte), length=1, event=event)
