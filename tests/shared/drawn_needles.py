"""Needles that tests draw by distance."""

from __future__ import annotations

import itertools
import math

import numpy as np


def cover_line(coverage: np.ndarray, points: np.ndarray, width: float) -> None:
    """Raise the coverage of pixels, 0 to 1, to that of a polyline, only around its segments."""
    shape = coverage.shape
    last = len(points) - 2
    for i, (first, second) in enumerate(itertools.pairwise(points)):
        low = np.maximum(np.floor(np.minimum(first, second) - width), 0).astype(int)
        high = np.ceil(np.maximum(first, second) + width).astype(int) + 1
        v, u = np.ogrid[low[1] : min(high[1], shape[0]), low[0] : min(high[0], shape[1])]
        length = float(np.linalg.norm(second - first))
        along_axis = (second - first) / length
        along = (u - first[0]) * along_axis[0] + (v - first[1]) * along_axis[1]
        across = np.abs((v - first[1]) * along_axis[0] - (u - first[0]) * along_axis[1])
        cover = np.clip(0.5 * width + 0.5 - across, 0, 1)
        # Square ends; inside, neighbouring pieces overlap.
        cover = cover * np.clip(length + (0.5 if i == last else 1.0) - along, 0, 1)
        cover = cover * np.clip(along + (0.5 if i == 0 else 1.0), 0, 1)
        block = coverage[low[1] : high[1], low[0] : high[0]]
        np.maximum(block, cover, out=block)


def arc(length: float, curvature: float, roll: float, pitch: float = 0.0) -> np.ndarray:
    """Return points of a needle path from the entry, (n, 3) in `rig`, and its tip last."""
    s = np.linspace(0.0, length, 120)
    if curvature == 0.0:
        side, ahead = np.zeros_like(s), s
    else:
        side = (1 - np.cos(curvature * s)) / curvature
        ahead = np.sin(curvature * s) / curvature
    x, y = side * math.sin(roll), side * math.cos(roll)
    return np.stack(
        [
            x * math.cos(pitch) + ahead * math.sin(pitch),
            y,
            ahead * math.cos(pitch) - x * math.sin(pitch),
        ],
        axis=-1,
    )
