"""A needle that is shown to a tracker, and then hidden."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.tracker import StereoTracker

Image = np.ndarray
Drawer = Callable[..., tuple[Image, Image]]
Arc = Callable[..., np.ndarray]
Views = tuple[RefractedCamera, RefractedCamera]


def last_seen(tracker: StereoTracker, shown: list[tuple[Image, Image]], *, until: int = 60) -> None:
    """Show a needle up to 52 mm, and then hands."""
    for mm, pair in enumerate(shown, 40):
        assert tracker.process(*pair, mm * 1e-3).tip is not None
    covered = np.full((768, 1024), 90, np.uint8)
    for mm in range(53, until + 1):
        assert tracker.process(covered, covered, mm * 1e-3).tip is None
