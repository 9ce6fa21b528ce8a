"""The SDO server of a CANopen device (CiA 301): expedited and segmented transfers, no blocks."""

from __future__ import annotations

from needle_sim.bus.object_dictionary import Abort, ObjectDictionary, SdoAbortError

# Command specifiers of the client, in the upper three bits of the first byte.
_DOWNLOAD_SEGMENT = 0
_INITIATE_DOWNLOAD = 1
_INITIATE_UPLOAD = 2
_UPLOAD_SEGMENT = 3
_ABORT = 4
_TOGGLE = 0x10
_SEGMENT = 7
_EXPEDITED = 4
# No object here is longer; a download beyond is refused.
_LONGEST = 128


class SdoServer:
    """Answers the requests of one client.

    Parameters
    ----------
    dictionary : ObjectDictionary
        What is read and written.
    """

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self._key = (0, 0)
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._toggle = 0
        self._handlers = {
            _DOWNLOAD_SEGMENT: self._download_segment,
            _INITIATE_DOWNLOAD: self._initiate_download,
            _INITIATE_UPLOAD: self._initiate_upload,
            _UPLOAD_SEGMENT: self._upload_segment,
        }

    def answer(self, request: bytes) -> bytes | None:
        """Return the answer to a request of 8 bytes; None to what wants none."""
        if len(request) != 8:
            return None
        specifier = request[0] >> 5
        if specifier == _ABORT:
            self._upload = self._download = None
            return None
        if specifier in (_INITIATE_DOWNLOAD, _INITIATE_UPLOAD):
            self._upload = self._download = None
            self._key = (int.from_bytes(request[1:3], "little"), request[3])
        try:
            return self._handlers.get(specifier, self._refuse)(request)
        except SdoAbortError as error:
            self._upload = self._download = None
            return b"\x80" + self._multiplexer + int(error.code).to_bytes(4, "little")

    def _refuse(self, _: bytes) -> bytes:
        raise SdoAbortError(Abort.COMMAND)

    @property
    def _multiplexer(self) -> bytes:
        index, subindex = self._key
        return index.to_bytes(2, "little") + bytes([subindex])

    def _initiate_download(self, request: bytes) -> bytes:
        command = request[0]
        if command & 2:
            unused = command >> 2 & 3 if command & 1 else 0
            self._dictionary.write(*self._key, request[4 : 8 - unused])
        else:
            self._dictionary.entry(*self._key)
            self._download = bytearray()
            self._toggle = 0
        return b"\x60" + self._multiplexer + bytes(4)

    def _download_segment(self, request: bytes) -> bytes:
        if self._download is None:
            raise SdoAbortError(Abort.COMMAND)
        self._check_toggle(request[0])
        unused = request[0] >> 1 & 7
        self._download += request[1 : 8 - unused]
        if len(self._download) > _LONGEST:
            raise SdoAbortError(Abort.WRONG_LENGTH)
        answer = bytes([0x20 | self._toggle]) + bytes(7)
        self._toggle ^= _TOGGLE
        if request[0] & 1:
            data = bytes(self._download)
            self._download = None
            self._dictionary.write(*self._key, data)
        return answer

    def _initiate_upload(self, _: bytes) -> bytes:
        data = self._dictionary.read(*self._key)
        if len(data) <= _EXPEDITED:
            command = 0x43 | (_EXPEDITED - len(data)) << 2
            return bytes([command]) + self._multiplexer + data.ljust(4, b"\0")
        self._upload = data
        self._toggle = 0
        return b"\x41" + self._multiplexer + len(data).to_bytes(4, "little")

    def _upload_segment(self, request: bytes) -> bytes:
        if self._upload is None:
            raise SdoAbortError(Abort.COMMAND)
        self._check_toggle(request[0])
        part, rest = self._upload[:_SEGMENT], self._upload[_SEGMENT:]
        command = self._toggle | (_SEGMENT - len(part)) << 1 | (not rest)
        self._upload = rest or None
        self._toggle ^= _TOGGLE
        return bytes([command]) + part.ljust(_SEGMENT, b"\0")

    def _check_toggle(self, command: int) -> None:
        if command & _TOGGLE != self._toggle:
            raise SdoAbortError(Abort.TOGGLE)
