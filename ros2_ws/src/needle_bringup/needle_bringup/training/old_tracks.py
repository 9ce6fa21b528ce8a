"""Random tracks of earlier needles in the gel, as factors of its brightness."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.needle_ends import Pose, coarse, draw_needle, random_pose, true_map
from needle_bringup.training.samples import moved

Image = NDArray[np.float32]

_FAINT = 0.15  # maximum change of brightness by a track without a background
_GEL_PX = 3.0  # maximum motion of the gel
_MOST = 3
_BROKEN, _PIECE_PX, _PIECES = 0.4, (5.0, 80.0), 60  # share in pieces; their length; their number


def drawn_tracks(rng: np.random.Generator, pose: Pose, size: int, *, faint: bool) -> Image:
    """Return the factor of each pixel's brightness by old tracks.

    Parameters
    ----------
    rng : Generator
        What draws them.
    pose : Pose
        Of the needle: some tracks run along it, and on beyond its end.
    size : int
        Width and height [px].
    faint : bool
        No track may look like a needle.
    """
    factor = np.ones((size, size), np.float32)
    for _ in range(rng.integers(1, _MOST + 1)):
        radius = pose.radius * rng.uniform(0.35, 1.3)
        if rng.random() < 0.35:
            place = pose.slid(rng.uniform(-20.0, 60.0))
            place = dataclasses.replace(
                place, heading=place.heading + rng.normal(0.0, 0.04), radius=radius
            )
        else:
            place = random_pose(rng, size, radius)
        if not faint and rng.random() < 0.45:
            grey = np.full((size, size), rng.uniform(60.0, 180.0), np.float32)
            like_needle = draw_needle(rng, grey, place) / grey
            factor *= faded(like_needle, rng.uniform(0.4, 1.0), rng.choice([0.0, 0.7, 1.5]))
        else:
            factor *= _cloudy(rng, place, size, faint)
    return factor


def shifted_tracks(rng: np.random.Generator, factor: Image) -> Image:
    """Return the tracks in the background image: unchanged, or shifted by motion of the gel."""
    if rng.random() < 0.5:
        return factor
    return moved(factor, rng.uniform(0.0, _GEL_PX), rng.uniform(0.0, 2.0 * np.pi))


def faded(factor: Image, strength: float, blur_px: float) -> Image:
    """Return a factor closer to 1, and blurred."""
    if blur_px > 0.0:
        factor = np.asarray(cv2.GaussianBlur(factor, (0, 0), blur_px), np.float32)
    return np.asarray(1.0 + np.float32(strength) * (factor - 1.0), np.float32)


def made_faint(factor: Image) -> Image:
    """Return a factor limited to small changes of brightness."""
    most = float(np.abs(factor - 1.0).max())
    return faded(factor, min(1.0, _FAINT / max(most, 1e-6)), 0.0)


def _cloudy(rng: np.random.Generator, pose: Pose, size: int, faint: bool) -> Image:
    """Return a torn, clouded track: soft, patchy, sometimes with two rims."""
    profile = true_map(pose, size)
    sigma = pose.radius * rng.uniform(0.15, 0.9)
    soft = cv2.GaussianBlur(profile, (0, 0), sigma)
    if rng.random() < 0.3:
        soft = np.abs(soft - cv2.GaussianBlur(profile, (0, 0), 2.0 * sigma + 0.5)) * 2.0
    patches = rng.uniform(-0.5, 1.5, (size // 8, size // 8)).astype(np.float32)
    patches = np.clip(cv2.resize(patches, (size, size), interpolation=cv2.INTER_CUBIC), 0.0, 1.0)
    share = rng.uniform(0.0, 0.9)
    soft = soft * (1.0 - share + share * patches)
    if rng.random() < _BROKEN:
        soft = soft * _pieces(rng, pose, size)
    most = _FAINT if faint else rng.choice([0.3, 0.8])
    return np.asarray(np.clip(1.0 + rng.uniform(-most, most) * soft, 0.1, 3.0), np.float32)


def _pieces(rng: np.random.Generator, pose: Pose, size: int) -> Image:
    """Return a mask of the pieces of a broken track."""
    along, _ = pose.coordinates(size)
    shortest, longest = np.log(_PIECE_PX)
    edges = np.cumsum(np.exp(rng.uniform(shortest, longest, _PIECES))) - 2.0 * size
    return coarse(np.searchsorted(edges, along).astype(np.float32) % 2)
