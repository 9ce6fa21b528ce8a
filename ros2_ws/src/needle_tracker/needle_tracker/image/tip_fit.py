"""Sub-pixel shaft line and end point of the needle in one image, from where it is expected."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from needle_tracker.image.detection import DetectionSettings, Image, Path
from needle_tracker.image.strip import LINE_WIDTHS
from needle_tracker.image.strip_fit import fit_strip

Array = NDArray[np.float64]

_LINE_SYSTEMATIC_PX = 0.018  # what calibration and the needle's bend leave in the line
_END_SYSTEMATIC_PX = 0.13  # bevel, blur, light: where "half" is
# An end that cannot be seen is hardly known; but the line is the needle's near that place only.
HIDDEN_END_PX = 8.0
_END_DOUBT_PX = 4.5  # for each unit of mass too little before, or left after, the end
_SOUND_END = 0.02
HIDDEN_FACTOR = 3.0  # what hides the end is beside the line too
_CLEAR_BEFORE = (0.65, 1.45)
_CLEAR_AFTER = 0.3
_PATH_SEARCH_PX = 6
_SURE_PX = 0.15


@dataclasses.dataclass(frozen=True)
class ImageTip:
    """The visible end of the needle in one image.

    Attributes
    ----------
    point : ndarray, shape (2,)
        The end [px].
    direction : ndarray, shape (2,)
        Unit vector along the shaft, towards the tip.
    sigma_across, sigma_along : float
        Standard deviations of the end across and along the shaft [px].
    sigma_angle : float
        Standard deviation of the direction [rad].
    contrast : float
        Needle against its surroundings [grey levels].
    visibility : float
        The same over the brighter of the two: as much in good light as in bad. A map does not say.
    clear : bool
        Whether the end itself is seen; otherwise only the shaft is.
    bright : bool
        Whether the needle is brighter than what is around it.
    allowance : float
        How many times worse than a line's it may be known and count as much. A line's end is where
        it is seen to end, and finely; a map's covers what a ground face hides.
    come : bool
        Whether it is seen where there was nothing of it in an earlier image of the recording.
    all_new : bool
        Whether it is seen where there was nothing of it in an image without any needle.
    """

    point: Array
    direction: Array
    sigma_across: float
    sigma_along: float
    sigma_angle: float
    contrast: float
    visibility: float
    clear: bool = True
    bright: bool = False
    allowance: float = 1.0
    come: bool = False
    all_new: bool = False

    @property
    def doubt_across(self) -> float:
        """Return how badly its line is known [px], as one that is as bad for a line."""
        return self.sigma_across / self.allowance


@dataclasses.dataclass(frozen=True)
class Expected:
    """Place where a tip is expected in an image.

    Attributes
    ----------
    point, direction : ndarray, shape (2,)
        End [px], and unit vector along the shaft towards it.
    room : float
        Visible shaft behind the end [px].
    search : int
        How far beside that the needle may be [px]; 0: hardly.
    sigma_along : float
        Of the end along the shaft [px]; 0: not known.
    contrast : float
        Of the needle so far [grey levels]; 0: not known.
    """

    point: Array
    direction: Array
    room: float
    search: int
    sigma_along: float
    contrast: float = 0.0


Fit = Callable[[Image, Expected, bool, DetectionSettings], ImageTip | None]


def fit_tip(
    image: Image,
    path: Path,
    settings: DetectionSettings,
    sigma_along: float = 0.0,
    fit: Fit | None = None,
) -> ImageTip | None:
    """Fit shaft line and end point near the end of a path.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The camera's image.
    path : Path
        Coarse path from `find_paths`.
    settings : DetectionSettings
        How the needle looks; the path says whether it is bright.
    sigma_along : float
        Of the path's end along the shaft [px]; 0: not known.
    fit : callable, optional
        In place of `fit_expected`.

    Returns
    -------
    ImageTip or None
        None where the image near the path's end does not look like the end of a needle.
    """
    point, direction = _coarse_line(path.pixels, LINE_WIDTHS * settings.needle_width_px)
    room = float(np.linalg.norm(path.pixels[0] - point)) + 2.0
    best: ImageTip | None = None
    # On the path itself first: a line beside the needle, such as its shadow, then hardly matters.
    for search in (0, _PATH_SEARCH_PX):
        expected = Expected(point, direction, room, search, sigma_along)
        tip = (fit or fit_expected)(image, expected, path.bright, settings)
        if tip is None:
            continue
        if tip.clear and tip.doubt_across < _SURE_PX:
            return tip
        if best is None or (tip.clear, -tip.sigma_across) > (best.clear, -best.sigma_across):
            best = tip
    return best


def fit_expected(
    image: Image, expected: Expected, bright: bool, settings: DetectionSettings
) -> ImageTip | None:
    """Fit shaft line and end point where they are expected.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The camera's image.
    expected : Expected
        Where to look.
    bright : bool
        Whether the needle is brighter than what is around it.
    settings : DetectionSettings
        How the needle looks.

    Returns
    -------
    ImageTip or None
        None where no shaft is seen, or no end and nothing said where it should be.
    """
    result = np.empty(12)
    found = fit_strip(
        image,
        np.ascontiguousarray(expected.point, dtype=np.float64),
        np.ascontiguousarray(expected.direction, dtype=np.float64),
        int(expected.room),
        expected.search,
        settings.needle_width_px,
        -1.0 if bright else 1.0,
        0.35 * settings.min_contrast,
        expected.sigma_along,
        expected.contrast,
        result,
    )
    if found != 1 or result[7] < settings.min_contrast:
        return None
    u, v, d_u, d_v, across, along, angle, contrast, before, after, far, light = result.tolist()
    clear = _CLEAR_BEFORE[0] < before < _CLEAR_BEFORE[1] and abs(after) < _CLEAR_AFTER
    if expected.sigma_along > 0.0 and abs(far) > 3.0 * expected.sigma_along:
        clear = False
    if not clear and expected.sigma_along <= 0.0:
        return None
    doubt = _END_DOUBT_PX * max(abs(before - 1.0) - _SOUND_END, abs(after) - _SOUND_END, 0.0)
    line_px = LINE_WIDTHS * settings.needle_width_px
    height, width = image.shape
    if not (2.0 <= u <= width - 3.0 and 2.0 <= v <= height - 3.0):
        return None
    return ImageTip(
        point=np.array([u, v]),
        direction=np.array([d_u, d_v]),
        sigma_across=math.hypot(across, _LINE_SYSTEMATIC_PX) * (1.0 if clear else HIDDEN_FACTOR),
        sigma_along=math.hypot(along, _END_SYSTEMATIC_PX, doubt) if clear else HIDDEN_END_PX,
        sigma_angle=math.hypot(angle, _LINE_SYSTEMATIC_PX / line_px),
        contrast=contrast,
        visibility=contrast / max(light + contrast if bright else light, 1.0),
        clear=clear,
        bright=bright,
    )


def hidden(tip: ImageTip) -> ImageTip:
    """Return a tip whose end does not count, only its line."""
    return dataclasses.replace(tip, sigma_along=HIDDEN_END_PX, clear=False)


def _coarse_line(pixels: Array, length: float) -> tuple[Array, Array]:
    """Return the end of a coarse path and its direction there."""
    distance = np.linalg.norm(pixels - pixels[-1], axis=1)
    last = pixels[distance <= length]
    centre = last.mean(axis=0)
    # The principal axis, in closed form.
    x, y = (last - centre).T
    angle = 0.5 * math.atan2(2.0 * float(x @ y), float(x @ x - y @ y))
    axis = np.array([math.cos(angle), math.sin(angle)])
    direction = axis if axis @ (last[-1] - last[0]) >= 0.0 else -axis
    end = centre + direction * float((pixels[-1] - centre) @ direction)
    return end, direction
