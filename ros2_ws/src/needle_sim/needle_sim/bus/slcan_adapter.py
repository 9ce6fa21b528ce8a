"""Serial CAN adapter, device side: the LAWICEL protocol ("slcan") of USB adapters.

Commands end with CR; the adapter answers CR for success, BEL for failure, `z` CR for a sent frame.
"""

from __future__ import annotations

import dataclasses

from needle_core.can_frame import CanFrame

DONE = b"\r"
REFUSED = b"\a"
_SENT = b"z\r"
_SENT_EXTENDED = b"Z\r"
# Time stamps, polling and filters are accepted without effect.
_ANSWERS = {bytes([kind]): DONE for kind in b"ZXMmQWUY"} | {b"": DONE}
_ANSWERS |= {b"V": b"V1013\r", b"N": b"NSIM1\r", b"F": b"F00\r"}
# Bound of the buffer; the longest command is an extended frame of 8 bytes.
_MAX_COMMAND = 64
_MAX_DATA = 8


@dataclasses.dataclass(frozen=True)
class SlcanInput:
    """Result of processing bytes from the computer.

    Attributes
    ----------
    frames : tuple of CanFrame
        Frames for the bus, in order.
    reply : bytes
        Answer of the adapter.
    closed : bool
        Whether the channel was closed, so that waiting output is obsolete.
    """

    frames: tuple[CanFrame, ...]
    reply: bytes
    closed: bool


class SlcanAdapter:
    """Converts bytes to frames and back; frames pass only while the channel is open."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._open = False

    def feed(self, data: bytes) -> SlcanInput:
        """Process bytes from the computer; incomplete commands are buffered."""
        self._buffer += data
        frames: list[CanFrame] = []
        reply = bytearray()
        closed = False
        while (end := self._buffer.find(DONE)) >= 0:
            command = bytes(self._buffer[:end])
            del self._buffer[: end + 1]
            closed = closed or command == b"C"
            reply += self._execute(command, frames)
        if len(self._buffer) > _MAX_COMMAND:
            self._buffer.clear()
            reply += REFUSED
        return SlcanInput(tuple(frames), bytes(reply), closed)

    def encode(self, frame: CanFrame) -> bytes:
        """Return the bytes of a frame for the computer; empty while the channel is closed."""
        if not self._open:
            return b""
        kind = "r" if frame.remote else "t"
        return (
            f"{kind}{frame.identifier:03X}{len(frame.data):d}{frame.data.hex().upper()}\r".encode()
        )

    def _execute(self, command: bytes, frames: list[CanFrame]) -> bytes:
        kind, rest = command[:1], command[1:]
        if kind in (b"t", b"T", b"r", b"R"):
            return self._send(kind, rest, frames)
        if kind in (b"S", b"s"):
            return REFUSED if self._open or not rest else DONE
        if command == b"C" or (command == b"O" and not self._open):
            self._open = command == b"O"
            return DONE
        return _ANSWERS.get(kind, REFUSED)

    def _send(self, kind: bytes, rest: bytes, frames: list[CanFrame]) -> bytes:
        if not self._open:
            return REFUSED
        extended = kind in b"TR"
        digits = 8 if extended else 3
        try:
            identifier = int(rest[:digits], 16)
            length = int(rest[digits : digits + 1])
            data = bytes.fromhex(rest[digits + 1 :].decode("ascii"))
        except ValueError:
            return REFUSED
        remote = kind in b"rR"
        if len(rest) < digits + 1 or length > _MAX_DATA or len(data) != (0 if remote else length):
            return REFUSED
        if extended:
            # The drives ignore 29-bit identifiers.
            return _SENT_EXTENDED
        if identifier > 0x7FF:
            return REFUSED
        frames.append(CanFrame(identifier, data, remote))
        return _SENT
