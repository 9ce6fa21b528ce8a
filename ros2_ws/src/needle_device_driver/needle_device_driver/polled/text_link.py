"""Connection that carries lines of text: a component passes its bytes in batches."""

from __future__ import annotations

import re
from collections.abc import Sequence

from needle_device_driver.axes.link import Link

# A longer line is none: the bytes are noise, or of another program [bytes].
_LONGEST_LINE = 1024


class TextLink(Link):
    """A connection that passes bytes.

    Parameters
    ----------
    name : str
        Name of the link in messages.
    terminators : bytes
        Each of these bytes ends a line.

    Attributes
    ----------
    bytes_sent, lines_received, garbled : int
        Counters; garbled are lines that are no ASCII text, or too long.
    """

    def __init__(self, name: str, terminators: bytes) -> None:
        super().__init__(name)
        self.bytes_sent = self.lines_received = self.garbled = 0
        # Behind a terminator.
        self._line_end = re.compile(b"(?<=[" + re.escape(terminators) + b"])")
        self._rest = b""
        self._outgoing = b""

    @property
    def counts(self) -> dict[str, str]:
        """Counters for diagnostics, by name."""
        names = ("bytes_sent", "lines_received", "garbled")
        return {name: str(getattr(self, name)) for name in names}

    def send(self, data: bytes) -> None:
        """Add bytes to the outgoing batch of the running handler.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        self._require_open()
        self._outgoing += data
        self.bytes_sent += len(data)

    def pop_outgoing(self) -> tuple[bytes, ...]:
        """Return the bytes that were sent since the last call."""
        data, self._outgoing = self._outgoing, b""
        return (data,) if data else ()

    def receive(self, chunks: Sequence[bytes]) -> list[str]:
        """Return the lines that are complete with these chunks, each with its terminator."""
        if not self.is_open:
            return []
        *lines, self._rest = self._line_end.split(self._rest + b"".join(chunks))
        if len(self._rest) > _LONGEST_LINE:
            lines, self._rest = [*lines, self._rest], b""
        texts = [
            line[:-1].decode().strip() + chr(line[-1])
            for line in lines
            if line.isascii() and len(line) <= _LONGEST_LINE
        ]
        self.garbled += len(lines) - len(texts)
        self.lines_received += len(texts)
        return texts

    def _restart(self) -> None:
        self._rest = b""
