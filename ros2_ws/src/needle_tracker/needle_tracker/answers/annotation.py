"""Report on a pair, in words and as a picture: what each view shows, and why there is no tip."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.filter.measurement import Measurement, NoTip, TrackState

Image = NDArray[np.uint8]

CLEAR = 0.5
"""Expected number of ends, or mean shaft probability, above which a view shows it."""
IN_ENTRY_ZONE = "in the entry zone"
_BY_VIEWS = {
    (False, False): NoTip.NOTHING.value,
    (True, False): "end seen in the left view only",
    (False, True): "end seen in the right view only",
    (True, True): "both views show an end but they do not meet",
}
_SCALE = 0.5
_GREEN, _YELLOW, _RED = (90, 230, 90), (255, 220, 60), (255, 80, 60)
_SHAFT_PX = 40.0
_CAPTION_PX = 44


def shows_end(end: ImageEnd | None) -> bool:
    """Return whether a view shows the end of the needle."""
    return end is not None and end.ends > CLEAR


def shows_shaft(end: ImageEnd | None) -> bool:
    """Return whether a view shows the shaft of the needle."""
    return end is not None and end.shaft > CLEAR


def missing(measured: Measurement) -> str:
    """Return why a pair has no tip; empty if it has one outside the entry zone."""
    if measured.state is TrackState.ENTRY:
        return IN_ENTRY_ZONE
    if measured.tip is not None:
        return ""
    if measured.reason != NoTip.NOTHING:
        return str(measured.reason)
    left, right = measured.ends
    return _BY_VIEWS[shows_end(left), shows_end(right)]


def annotate(left: Image, right: Image, measured: Measurement) -> Image:
    """Draw shaft line, tip and state over a pair.

    Parameters
    ----------
    left, right : ndarray of uint8, shape (height, width)
        The pair.
    measured : Measurement
        Result of the tracker.

    Returns
    -------
    ndarray of uint8, shape (rows, columns, 3)
        RGB, at half size: left and right side by side, each above its description, and a line of
        text. Green: a clear end; yellow: an unclear end; red: found but rejected.
    """
    views = [
        _view(image, end, measured.tip is not None)
        for image, end in zip((left, right), measured.ends, strict=True)
    ]
    height = max(view.shape[0] for view in views)
    views = [cv2.copyMakeBorder(v, 0, height - len(v), 0, 2, cv2.BORDER_CONSTANT) for v in views]
    picture = cv2.copyMakeBorder(np.hstack(views), 0, _CAPTION_PX, 0, 0, cv2.BORDER_CONSTANT)
    starts = (0, views[0].shape[1])
    for start, end in zip(starts, measured.ends, strict=True):
        _write(picture, describe_view(end), start, height + 16)
    _write(picture, describe(measured), 0, height + 36)
    return np.asarray(picture, dtype=np.uint8)


def describe(measured: Measurement) -> str:
    """Return one line of text: the state, and the tip or the reason for none."""
    if measured.tip is None:
        return f"{measured.state.value}: {missing(measured)}"
    position = ", ".join(
        f"{axis} {1e3 * value:.2f} +- {1e3 * math.sqrt(variance):.2f}"
        for axis, value, variance in zip(
            "xyz", measured.tip.position, np.diag(measured.tip.covariance), strict=True
        )
    )
    return f"{measured.state.value}: {position} mm" + (
        f" ({measured.reason})" if measured.reason else ""
    )


def describe_view(end: ImageEnd | None) -> str:
    """Return one line of text: expected number of ends and shaft probability in a view."""
    return "nothing found" if end is None else f"end {end.ends:.2f}, shaft {end.shaft:.2f}"


def _write(picture: Image, text: str, u: int, v: int) -> None:
    font, white = cv2.FONT_HERSHEY_SIMPLEX, (255, 255, 255)
    cv2.putText(picture, text, (u + 8, v), font, 0.5, white, 1, cv2.LINE_AA)


def _view(image: Image, end: ImageEnd | None, believed: bool) -> Image:
    small = cv2.resize(image, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_AREA)
    view = cv2.cvtColor(small, cv2.COLOR_GRAY2RGB)
    if end is not None:
        colour = _RED if not believed else _GREEN if shows_end(end) else _YELLOW
        line = np.stack([end.point - _SHAFT_PX * end.direction, end.point])
        small_line = np.clip((line + 0.5) * _SCALE - 0.5, -1e4, 1e4)
        start, tip = np.rint(small_line).astype(int).tolist()
        cv2.line(view, start, tip, colour, 1, cv2.LINE_AA)
        cv2.circle(view, tip, 5, colour, 1, cv2.LINE_AA)
    return np.asarray(view, dtype=np.uint8)
