"""Both views side by side with what the tracker made of them, for a person to look at."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.image.tip_fit import Expected, ImageTip
from needle_tracker.tracking.measurement import Measurement

Image = NDArray[np.uint8]

_SCALE = 0.5
_BLUE, _GREEN, _YELLOW, _RED = (80, 160, 255), (90, 230, 90), (255, 220, 60), (255, 80, 60)
_SHAFT_PX = 40.0
_SHIFT = 4  # sub-pixel drawing: OpenCV takes fixed-point numbers
_BAR_PX = 26
_AHEAD_PX = 30.0


def annotate(left: Image, right: Image, measured: Measurement) -> Image:
    """Draw region, shaft line, tip and state over a pair.

    Parameters
    ----------
    left, right : ndarray of uint8, shape (height, width)
        The pair.
    measured : Measurement
        What the tracker answered.

    Returns
    -------
    ndarray of uint8, shape (rows, columns, 3)
        RGB, at half the size: left and right side by side, a line of text below. Blue: the region
        that was searched (none: everything was); green: a clear end; yellow: only the line counts;
        red: found but not believed.
    """
    views = [
        _view(image, tip, region, measured.tip is not None)
        for image, tip, region in zip(
            (left, right), measured.image_tips, measured.regions, strict=True
        )
    ]
    height = max(view.shape[0] for view in views)
    views = [cv2.copyMakeBorder(v, 0, height - len(v), 0, 2, cv2.BORDER_CONSTANT) for v in views]
    picture = cv2.copyMakeBorder(np.hstack(views), 0, _BAR_PX, 0, 0, cv2.BORDER_CONSTANT)
    cv2.putText(
        picture,
        describe(measured),
        (8, picture.shape[0] - 8),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.5,
        (255, 255, 255),
        1,
        cv2.LINE_AA,
    )
    return np.asarray(picture, dtype=np.uint8)


def describe(measured: Measurement) -> str:
    """Return one line of text: the state, the tip, and why there is none, or of one view alone."""
    if measured.tip is None:
        return f"{measured.state.value}: {measured.reason}"
    place = ", ".join(
        f"{axis} {1e3 * value:.2f} +- {1e3 * math.sqrt(variance):.2f}"
        for axis, value, variance in zip(
            "xyz", measured.tip.position, np.diag(measured.tip.covariance), strict=True
        )
    )
    return f"{measured.state.value}: {place} mm" + (
        f" ({measured.reason})" if measured.reason else ""
    )


def _view(image: Image, tip: ImageTip | None, region: Expected | None, believed: bool) -> Image:
    small = cv2.resize(image, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_AREA)
    view = cv2.cvtColor(small, cv2.COLOR_GRAY2RGB)
    if region is not None:
        along = region.direction
        across = np.array([-along[1], along[0]])
        behind = min(region.room, 1.4 * _SHAFT_PX)
        half = max(region.search, 6)
        corners = [
            region.point + a * along + b * across
            for a, b in ((-behind, -half), (-behind, half), (_AHEAD_PX, half), (_AHEAD_PX, -half))
        ]
        cv2.polylines(view, [_fixed(np.array(corners))], True, _BLUE, 1, cv2.LINE_AA, _SHIFT)
    if tip is not None:
        colour = _RED if not believed else _GREEN if tip.clear else _YELLOW
        line = np.stack([tip.point - _SHAFT_PX * tip.direction, tip.point])
        cv2.polylines(view, [_fixed(line)], False, colour, 1, cv2.LINE_AA, _SHIFT)
        u, v = (int(part) for part in _fixed(tip.point[None])[0, 0])
        cv2.circle(view, (u, v), 5 << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
    return np.asarray(view, dtype=np.uint8)


def _fixed(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return points of the full image as OpenCV draws them in the small one."""
    small = (points + 0.5) * _SCALE - 0.5
    return np.round(np.clip(small, -1e4, 1e4) * (1 << _SHIFT)).astype(np.int32).reshape(-1, 1, 2)
