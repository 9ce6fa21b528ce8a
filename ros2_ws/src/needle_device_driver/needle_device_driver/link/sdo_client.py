"""canopen's SDO client for drives that take their time, and a loop that must not fall silent."""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any

from canopen import SdoAbortedError, SdoCommunicationError
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient

# A drive that writes to its flash, or sets its PDOs up anew, takes some tenths of a second [s].
_RESPONSE_WAIT = 0.5
_ATTEMPTS = 2
_ABORTED = 0x80
_TIMED_OUT = 0x0504_0000
# Client commands of the first frame of a transfer: its answer names the object.
_INITIATE = (0x20, 0x40)


class PatientSdoClient(SdoClient):
    """canopen's client with two changes.

    While it waits, `beat` is called every `period`, so that the watchdog of no drive trips over
    another's slowness. An answer to an earlier request, given up as lost and come late, is none to
    the present one.

    Parameters
    ----------
    node_id : int
        Whose object dictionary.
    beat : callable
        Sends the computer's heartbeat.
    period : float
        Of the heartbeat [s].
    wait : callable
        Waits until what it is given returns true, at most so long [s].
    """

    def __init__(
        self,
        node_id: int,
        beat: Callable[[], None],
        period: float,
        wait: Callable[[Callable[[], bool], float], Any],
    ) -> None:
        # Entries are addressed by number: canopen needs to know none by name.
        super().__init__(0x600 + node_id, 0x580 + node_id, ObjectDictionary())  # type: ignore[no-untyped-call]
        self._beat = beat
        self._period = period
        self._wait = wait

    def request_response(self, sdo_request: bytes) -> bytes:
        """Send a request and return the answer to it.

        Raises
        ------
        SdoAbortedError
            If the drive refuses.
        SdoCommunicationError
            If it does not answer.
        """
        for _ in range(_ATTEMPTS):
            self.responses = queue.Queue()
            self.send_request(sdo_request)  # type: ignore[no-untyped-call]
            response = self._await(bytes(sdo_request))
            if response is None:
                continue
            if response[0] == _ABORTED:
                raise SdoAbortedError(int.from_bytes(response[4:8], "little"))
            return response
        self.abort(_TIMED_OUT)  # type: ignore[no-untyped-call]
        raise SdoCommunicationError("No SDO response received")

    def _await(self, request: bytes) -> bytes | None:
        for _ in range(round(_RESPONSE_WAIT / self._period)):
            self._wait(lambda: not self.responses.empty(), self._period)
            while not self.responses.empty():
                # Eight bytes; not every drive sends those that it does not need.
                response = bytes(self.responses.get_nowait()).ljust(8, b"\0")
                if _answers(response, request):
                    return response
            self._beat()
        return None


def _answers(response: bytes, request: bytes) -> bool:
    return request[0] & 0xE0 not in _INITIATE or response[1:4] == request[1:4]
