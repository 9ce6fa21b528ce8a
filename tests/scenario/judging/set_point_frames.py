"""Set-points of the drives, read off the frames that are sent to them."""

from __future__ import annotations

from collections.abc import Mapping

# Function codes of the process data that carry controlword and mode, and the target (CiA 402).
_CONTROL, _TARGET = 0x200, 0x300
# Bits of the controlword that let a drive operate, and cyclic synchronous position mode.
_OPERATE, _CYCLIC_POSITION = 0x0F, 8


class SetPointFrames:
    """Reads frames.

    Parameters
    ----------
    counts_per_unit : mapping of int to float
        Of the drives, by their node ids [1/m] or [1/rad].
    """

    def __init__(self, counts_per_unit: Mapping[int, float]) -> None:
        self._counts_per_unit = counts_per_unit
        self._operates = dict.fromkeys(counts_per_unit, False)

    def take(self, identifier: int, data: bytes) -> tuple[int, float | None] | None:
        """Return a drive's node id and where it shall go.

        Parameters
        ----------
        identifier : int
            Of a frame.
        data : bytes
            Its own.

        Returns
        -------
        tuple of int and (float or None), or None
            [m] or [rad]; None in its place if the drive shall not go there. None for other frames.
        """
        node, function = identifier & 0x7F, identifier & ~0x7F
        if node not in self._operates or function not in (_CONTROL, _TARGET):
            return None
        if function == _CONTROL:
            self._operates[node] = data[0] & _OPERATE == _OPERATE and data[2] == _CYCLIC_POSITION
        if not self._operates[node]:
            return node, None
        if function == _CONTROL:
            return None
        counts = int.from_bytes(data[:4], "little", signed=True)
        return node, counts / self._counts_per_unit[node]
