"""SDO client (CiA 301): reads and writes entries of a node, expedited and in segments.

A transfer is a procedure: it sends a request and goes on when the answer is there. Drives take
their time, so one that does not answer is asked twice; while it waits, the computer's heartbeat
goes out, so that the watchdog of no drive trips over another's slowness.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable

from needle_device_driver.link.objects import SDO_REQUEST
from needle_device_driver.link.sdo_aborts import TIMED_OUT, SdoAbortedError, SdoSilenceError
from needle_device_driver.procedure import Procedure, Wait

# A drive that writes to its flash, or sets its PDOs up anew, takes some tenths of a second [s].
_RESPONSE_WAIT = 0.5
_ATTEMPTS = 2

# Command specifiers, the upper three bits of the first byte: of requests, and of their answers.
_SPECIFIER = 0xE0
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 0x00, 0x20, 0x40, 0x60, 0x80
_ANSWER_TO = {_DOWNLOAD: 0x60, _UPLOAD: 0x40, _DOWNLOAD_SEGMENT: 0x20, _UPLOAD_SEGMENT: 0x00}
# Answers to these name the entry; those to segments toggle a bit.
_INITIATE = (_DOWNLOAD, _UPLOAD)
_TOGGLE = 0x10
_EXPEDITED, _SIZE_IS_TOLD, _LAST_SEGMENT = 0x02, 0x01, 0x01
_EXPEDITED_SIZE, _SEGMENT_SIZE = 4, 7


class SdoClient:
    """Client of one node.

    Parameters
    ----------
    node_id : int
        Whose object dictionary.
    send : callable
        Sends a frame: COB-ID and data.
    beat : callable
        Sends the computer's heartbeat.
    period : float
        Of the heartbeat [s].
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
        """Take a frame of the node's SDO server."""
        # Eight bytes; not every drive sends those that it does not need.
        self._responses.append(data.ljust(8, b"\0"))

    def upload(self, index: int, subindex: int) -> Procedure[bytes]:
        """Return an entry's value.

        Raises
        ------
        SdoAbortedError
            If the node refuses.
        SdoSilenceError
            If it does not answer.
        """
        address = struct.pack("<HB", index, subindex)
        response = yield from self._exchange(bytes([_UPLOAD]) + address + bytes(4))
        size = None
        if response[0] & _EXPEDITED:
            unused = response[0] >> 2 & 3 if response[0] & _SIZE_IS_TOLD else 0
            return response[4 : 8 - unused]
        if response[0] & _SIZE_IS_TOLD:
            size = int.from_bytes(response[4:8], "little")
        data, toggle = b"", 0
        while True:
            response = yield from self._exchange(bytes([_UPLOAD_SEGMENT | toggle]) + bytes(7))
            data += response[1 : 8 - (response[0] >> 1 & 7)]
            if response[0] & _LAST_SEGMENT:
                return data[:size]
            toggle ^= _TOGGLE

    def download(self, index: int, subindex: int, data: bytes) -> Procedure[None]:
        """Write an entry; raises as `upload`."""
        address = struct.pack("<HB", index, subindex)
        if 0 < len(data) <= _EXPEDITED_SIZE:
            unused = _EXPEDITED_SIZE - len(data)
            command = _DOWNLOAD | unused << 2 | _EXPEDITED | _SIZE_IS_TOLD
            yield from self._exchange(bytes([command]) + address + data.ljust(4, b"\0"))
            return
        size = len(data).to_bytes(4, "little")
        yield from self._exchange(bytes([_DOWNLOAD | _SIZE_IS_TOLD]) + address + size)
        toggle = 0
        for begin in range(0, max(len(data), 1), _SEGMENT_SIZE):
            part = data[begin : begin + _SEGMENT_SIZE]
            is_last = begin + _SEGMENT_SIZE >= len(data)
            command = _DOWNLOAD_SEGMENT | toggle | (_SEGMENT_SIZE - len(part)) << 1 | is_last
            yield from self._exchange(bytes([command]) + part.ljust(_SEGMENT_SIZE, b"\0"))
            toggle ^= _TOGGLE

    def _exchange(self, request: bytes) -> Procedure[bytes]:
        """Send a request and return the answer to it."""
        for _ in range(_ATTEMPTS):
            # An answer to an earlier request, given up as lost and come late, is none to this one.
            self._responses.clear()
            self._send(self._cob_id, request)
            response = yield from self._await(request)
            if response is None:
                continue
            if response[0] == _ABORT:
                raise SdoAbortedError(int.from_bytes(response[4:8], "little"))
            return response
        self._send(self._cob_id, bytes([_ABORT]) + bytes(3) + TIMED_OUT.to_bytes(4, "little"))
        raise SdoSilenceError

    def _await(self, request: bytes) -> Procedure[bytes | None]:
        for _ in range(round(_RESPONSE_WAIT / self._period)):
            yield Wait(lambda: bool(self._responses), self._period)
            while self._responses:
                response = self._responses.popleft()
                if _answers(response, request):
                    return response
            self._beat()
        return None


def _answers(response: bytes, request: bytes) -> bool:
    specifier = request[0] & _SPECIFIER
    names_entry = specifier in _INITIATE
    if names_entry and response[1:4] != request[1:4]:
        return False
    if response[0] == _ABORT:
        return True
    toggles = names_entry or response[0] & _TOGGLE == request[0] & _TOGGLE
    return toggles and response[0] & _SPECIFIER == _ANSWER_TO[specifier]
