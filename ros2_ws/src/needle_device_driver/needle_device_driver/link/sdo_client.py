"""SDO client (CiA 301) for entries of at most four bytes; uploads may be longer.

A transfer is a procedure: it sends a request and resumes when the answer arrives. The client
repeats a request once. While it waits, it sends the computer's heartbeat, so that a slow drive
does not trip the watchdog of another one.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable

from needle_device_driver.link.error_codes import TIMED_OUT, describe_abort
from needle_device_driver.link.objects import SDO_REQUEST
from needle_device_driver.procedure import Procedure, Wait

# A drive that writes to its flash memory or maps its PDOs takes a few tenths of a second [s].
_RESPONSE_TIMEOUT = 0.5
_ATTEMPTS = 2

# Command specifiers, the upper three bits of the first byte: of requests, and of their responses.
_SPECIFIER = 0xE0
_DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 0x20, 0x40, 0x60, 0x80
_RESPONSE_TO = {_DOWNLOAD: 0x60, _UPLOAD: 0x40, _UPLOAD_SEGMENT: 0x00}
_TOGGLE = 0x10
_EXPEDITED, _HAS_SIZE, _LAST_SEGMENT = 0x02, 0x01, 0x01
_MAX_EXPEDITED = 4


class SdoAbortedError(Exception):
    """A drive aborted a transfer.

    Parameters
    ----------
    code : int
        SDO abort code.
    """

    def __init__(self, code: int) -> None:
        super().__init__(describe_abort(code))
        self.code = code


class SdoTimeoutError(Exception):
    """A drive does not answer."""


class SdoClient:
    """SDO client for one node.

    Parameters
    ----------
    node_id : int
        The node.
    send : callable
        Sends a frame: COB-ID and data.
    beat : callable
        Sends the computer's heartbeat.
    period : float
        Period of the heartbeat [s].
    """

    def __init__(
        self,
        node_id: int,
        send: Callable[[int, bytes], None],
        beat: Callable[[], None],
        period: float,
    ) -> None:
        self._cob_id = SDO_REQUEST + node_id
        self._send = send
        self._beat = beat
        self._period = period
        self._responses: deque[bytes] = deque()

    def receive(self, data: bytes) -> None:
        """Receive a frame of the node's SDO server."""
        # Some drives omit the unused bytes.
        self._responses.append(data.ljust(8, b"\0"))

    def upload(self, index: int, subindex: int) -> Procedure[bytes]:
        """Return the value of an entry.

        Raises
        ------
        SdoAbortedError
            If the node aborts the transfer.
        SdoTimeoutError
            If it does not answer.
        """
        address = struct.pack("<HB", index, subindex)
        response = yield from self._exchange(bytes([_UPLOAD]) + address + bytes(4))
        size = None
        if response[0] & _EXPEDITED:
            unused = response[0] >> 2 & 3 if response[0] & _HAS_SIZE else 0
            return response[4 : 8 - unused]
        if response[0] & _HAS_SIZE:
            size = int.from_bytes(response[4:8], "little")
        data, toggle = b"", 0
        while True:
            response = yield from self._exchange(bytes([_UPLOAD_SEGMENT | toggle]) + bytes(7))
            data += response[1 : 8 - (response[0] >> 1 & 7)]
            if response[0] & _LAST_SEGMENT:
                return data[:size]
            toggle ^= _TOGGLE

    def download(self, index: int, subindex: int, data: bytes) -> Procedure[None]:
        """Write one to four bytes to an entry; raises the same errors as `upload`."""
        command = _DOWNLOAD | (_MAX_EXPEDITED - len(data)) << 2 | _EXPEDITED | _HAS_SIZE
        request = struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0")
        yield from self._exchange(request)

    def _exchange(self, request: bytes) -> Procedure[bytes]:
        """Send a request and return its response."""
        for _ in range(_ATTEMPTS):
            # Discard late responses to earlier requests.
            self._responses.clear()
            self._send(self._cob_id, request)
            response = yield from self._await_response(request)
            if response is None:
                continue
            if response[0] == _ABORT:
                raise SdoAbortedError(int.from_bytes(response[4:8], "little"))
            return response
        self._send(self._cob_id, bytes([_ABORT]) + bytes(3) + TIMED_OUT.to_bytes(4, "little"))
        raise SdoTimeoutError

    def _await_response(self, request: bytes) -> Procedure[bytes | None]:
        for _ in range(round(_RESPONSE_TIMEOUT / self._period)):
            yield Wait(lambda: bool(self._responses), self._period)
            while self._responses:
                response = self._responses.popleft()
                if _is_response(response, request):
                    return response
            self._beat()
        return None


def _is_response(response: bytes, request: bytes) -> bool:
    specifier = request[0] & _SPECIFIER
    # A response repeats the entry's address, or the toggle bit of a segment.
    is_segment = specifier == _UPLOAD_SEGMENT
    if not is_segment and response[1:4] != request[1:4]:
        return False
    if response[0] == _ABORT:
        return True
    same_toggle = not is_segment or response[0] & _TOGGLE == request[0] & _TOGGLE
    return same_toggle and response[0] & _SPECIFIER == _RESPONSE_TO[specifier]
