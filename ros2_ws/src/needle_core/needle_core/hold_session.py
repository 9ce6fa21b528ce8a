"""Hold messages of one source, from its start to its end."""

from __future__ import annotations

from needle_core.messages import HOLD_LIFETIME, HoldState


class HoldSession:
    """Makes a source's hold messages.

    They are numbered, so that a late one shows, and told from those of an earlier process of the
    same name by the session.

    Parameters
    ----------
    source : str
        Name by which the device knows whose hold it is.
    lifetime : float
        How long a message promises the hold [s]; infinite: the device's own time-out.
    """

    def __init__(self, source: str, lifetime: float = HOLD_LIFETIME) -> None:
        self._source, self._lifetime = source, lifetime
        self._session = ""
        self._count = 0

    def say(self, stamp_ns: int, *, pressed: bool, speed: float = 1.0) -> HoldState:
        """Return the next message.

        Parameters
        ----------
        stamp_ns : int
            Present time [ns]. That of the first message names the session: no other process of
            this source begins in the same nanosecond, whatever its clock shows.
        pressed : bool
            Whether hold to run is pressed.
        speed : float
            Share of the nominal speed, 0..1.
        """
        self._session = self._session or f"{stamp_ns:x}"
        self._count += 1
        speed = speed if pressed else 0.0
        return HoldState(self._source, self._session, self._count, pressed, speed, self._lifetime)
