"""Connection that carries lines of text: a component passes its bytes in batches."""

from __future__ import annotations

from collections.abc import Sequence

from needle_device_driver.axes.drive_errors import LinkError

# A longer line is none: the bytes are noise, or of another program [bytes].
_LONGEST_LINE = 1024


class TextLink:
    """One connection, which can be opened, lost and opened again.

    A lost link stays lost until `open` is called: the drives have missed orders.

    Parameters
    ----------
    name : str
        Name of the link in messages.
    terminators : bytes
        Each of these bytes ends a line.

    Attributes
    ----------
    now : float
        Steady time of the running handler [s].
    lost : str
        Reason why the link was lost; empty: it was not.
    openings : int
        How often the link was opened.
    bytes_sent, lines_received, garbled : int
        Counters; garbled are lines that are no ASCII text.
    """

    def __init__(self, name: str, terminators: bytes) -> None:
        self.name = name
        self.now = 0.0
        self.lost = ""
        self.openings = self.bytes_sent = self.lines_received = self.garbled = 0
        self._terminators = terminators
        self._is_open = False
        self._port_error = ""
        self._rest = b""
        self._outgoing = b""

    @property
    def is_open(self) -> bool:
        """Whether bytes pass."""
        return self._is_open and not self.lost

    def open(self) -> None:
        """Open the link, also after a loss.

        Raises
        ------
        LinkError
            If the port is not open.
        """
        if self.is_open:
            return
        if self._port_error:
            raise LinkError(f"cannot open {self.name}: {self._port_error}")
        self._is_open = True
        self.lost = ""
        self._rest = b""
        self.openings += 1

    def set_port_error(self, error: str) -> None:
        """Note why the port is not open; empty: it is open."""
        self._port_error = error
        if error and self.is_open:
            self.lost = f"link {self.name} is lost: {error}"

    def close(self) -> None:
        """Close the link."""
        self._is_open = False

    def send(self, data: bytes) -> None:
        """Add bytes to the outgoing batch of the running handler.

        Raises
        ------
        LinkError
            If the link is closed or lost.
        """
        if not self.is_open:
            raise LinkError(self.lost or f"{self.name} is not open")
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
        lines = []
        for byte in b"".join(chunks):
            self._rest += bytes([byte])
            if byte in self._terminators:
                lines.append(self._rest)
                self._rest = b""
            elif len(self._rest) > _LONGEST_LINE:
                self._rest = b""
                self.garbled += 1
        texts = []
        for line in lines:
            if line.isascii():
                texts.append(line[:-1].decode().strip() + chr(line[-1]))
            else:
                self.garbled += 1
        self.lines_received += len(texts)
        return texts
