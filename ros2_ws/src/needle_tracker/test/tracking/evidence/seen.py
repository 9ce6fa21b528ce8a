"""Tips, lines and a track, as the tests of evidence need them."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.track import Track
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip

Views = tuple[RefractedCamera, RefractedCamera]
GOOD = ImageTip(np.zeros(2), np.array([1.0, 0.0]), 0.05, 0.15, 0.005, 100.0, 0.6)
POOR = dataclasses.replace(GOOD, sigma_across=0.7)
AHEAD = np.array([0.0, 0.0, 1.0])


def tip(x: float = 0.0, z: float = 0.05, sigma: float = 0.03e-3) -> SpatialTip:
    covariance = sigma**2 * np.eye(3)
    return SpatialTip(np.array([x, 0.0, z]), covariance, AHEAD, 1e-4 * np.eye(3), 0.0, 0.0)


def established(settings: TrackerSettings) -> Track:
    """Return a track that both views showed for 20 mm, to an insertion of 60 mm."""
    track = Track(settings.gates)
    for z in np.arange(0.040, 0.0601, 0.001):
        track.accept(tip(z=float(z)), float(z))
    return track
