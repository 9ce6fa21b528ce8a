"""Newest images of both cameras, drawn and compressed only for who asks."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

from needle_console.view.overlay import Image, draw_view
from needle_console.view.snapshot import Snapshot
from needle_tracker.optics.refraction import RefractedCamera

SIDES = ("left", "right")
# No view is drawn anew more often [s].
PERIOD = 0.1
# An image counts so long [s].
_COUNTS_FOR = 2.0


class CameraFeed:
    """Two views; any thread may put images in or ask for pictures.

    All times are readings of one steady clock [s].

    Parameters
    ----------
    cameras : mapping of str to RefractedCamera
        By side; a side that is missing is shown without the needle.
    snapshot : callable
        Returns the rig as it is now.
    """

    def __init__(
        self, cameras: Mapping[str, RefractedCamera], snapshot: Callable[[], Snapshot]
    ) -> None:
        self._cameras = cameras
        self._snapshot = snapshot
        self._lock = threading.Lock()
        self._images: dict[str, tuple[Image, float]] = {}
        self._pictures: dict[str, tuple[bytes, float]] = {}

    def put(self, side: str, image: Image, now: float) -> None:
        """Take an image, grey, shape (height, width)."""
        with self._lock:
            self._images[side] = image, now

    def picture(self, side: str, now: float) -> bytes | None:
        """Return the JPEG of a side's newest image; None where none has come lately."""
        with self._lock:
            image, came = self._images.get(side, (None, -math.inf))
            if image is None or now - came > _COUNTS_FOR:
                return None
            picture, drawn = self._pictures.get(side, (b"", -math.inf))
        if now - drawn < PERIOD:
            return picture
        picture = draw_view(image, self._snapshot(), self._cameras.get(side))
        with self._lock:
            self._pictures[side] = picture, now
        return picture
