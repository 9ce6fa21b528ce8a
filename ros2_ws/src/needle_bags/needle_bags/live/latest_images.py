"""Which image is drawn next: the newest whose answer is known, or one that gets none."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

# After so long without an answer images are drawn without one [s].
_PATIENCE = 0.5
# Exposures that a tracker may be behind.
_KEPT = 6


class LatestImages:
    """Images of one camera, until they are drawn."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, Image]] = deque(maxlen=_KEPT)
        self._answered_at: float | None = None

    def add(self, stamp_ns: int, image: Image) -> None:
        """Take an image, grey, shape (height, width), exposed at `stamp_ns` [ns]."""
        self._waiting.append((stamp_ns, image))

    def next(self, answered_ns: int | None, now: float) -> tuple[int, bool, Image] | None:
        """Return the image to draw now, once.

        Parameters
        ----------
        answered_ns : int or None
            Exposure of the tracker's last answer [ns].
        now : float
            Steady time [s].

        Returns
        -------
        tuple or None
            Time of exposure [ns], whether it is the answered one, and the image.
        """
        if self._answered_at is None:
            self._answered_at = now
        for stamp_ns, image in tuple(self._waiting):
            if stamp_ns == answered_ns:
                self._answered_at = now
                while self._waiting.popleft()[0] != stamp_ns:
                    pass
                return stamp_ns, True, image
        if not self._waiting or now - self._answered_at <= _PATIENCE:
            return None
        stamp_ns, image = self._waiting[-1]
        self._waiting.clear()
        return stamp_ns, False, image
