"""Look for a followed needle where it must be, and weigh what two views say against that.

The tip goes where the stage pushes it, and bends little on the way: the prediction says across each
view how far it may be, and along it how far the needle goes. What crosses, hides or lengthens the
needle in one view then shows, and that view counts for less.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.image.detection import DetectionSettings, Image
from needle_tracker.image.looks import LINE_LOOKS, Look
from needle_tracker.image.tip_fit import Expected, ImageTip, hidden
from needle_tracker.optics.compiled_projection import point_jacobian, project_point
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.tip_prediction import Anchor, TipMotion

Array = NDArray[np.float64]

PLAIN_PX, PLAIN_ALONG_PX = 0.12, 1.0  # standard deviations of an end beyond doubt [px]
SOUND_PX, SOUND_ALONG_PX = 0.3, 2.0  # of an end that is seen well
_SIDEWAYS = 0.9e-3  # the strip reaches so far beside the prediction [m] ...
_ALONG = 0.22e-3  # ... and its end is known so well along the shaft (one sigma) [m]
_SPREAD = 0.1  # both grow with the way ahead
FOLLOW_AHEAD = 8e-3  # farther from the last tip, all is searched [m]
_FOLLOW_DIRECTLY = 6e-3  # up to here the prediction is as good as the strip is wide [m]
_ODD, _STRANGE = 2.0, 4.0  # standard deviations
SLACK = 0.05e-3  # of the stage and the needle, along it [m]
_LOOSE_ANGLE = 0.1  # [rad]


class Follower:
    """Fits shaft and end in a strip about their prediction.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    detection : pair of DetectionSettings
        How the needle looks in each.
    needle_width : float
        Its diameter [m].
    hole_clearance : float
        Radius around the entry that is not looked at [m].
    looks : pair of Look
        How each image is looked at; at its lines by default.

    Attributes
    ----------
    views, looks : pair of RefractedCamera, pair of Look
        As given.
    """

    def __init__(
        self,
        views: tuple[RefractedCamera, RefractedCamera],
        detection: tuple[DetectionSettings, DetectionSettings],
        needle_width: float,
        hole_clearance: float,
        looks: tuple[Look, Look] = LINE_LOOKS,
    ) -> None:
        self.views = views
        self.looks = looks
        self._detection = detection
        self._scales = tuple(look.needle_width_px / needle_width for look in detection)
        self._entries = tuple(view.project(np.zeros(3)) for view in views)
        self._hole_clearance = hole_clearance

    def look(
        self, images: tuple[Image, Image], predicted: Anchor, last: tuple[ImageTip, ImageTip]
    ) -> tuple[tuple[ImageTip, ImageTip], tuple[Expected, Expected]] | None:
        """Return both views' ends and where they were looked for; None where one has none.

        Parameters
        ----------
        images : pair of ndarray of uint8
            Left and right.
        predicted : Anchor
            Where the tip must be now.
        last : pair of ImageTip
            How it was seen last.
        """
        left, right = (self.look_in(i, images[i], predicted, last[i]) for i in range(2))
        if left is None or right is None:
            return None
        return (left[0], right[0]), (left[1], right[1])

    def look_in(
        self, i: int, image: Image, predicted: Anchor, last: ImageTip
    ) -> tuple[ImageTip, Expected] | None:
        """Return one view's end and where it was looked for; None where there is none.

        Parameters
        ----------
        i : int
            0: left, 1: right.
        image : ndarray of uint8
            Of that camera.
        predicted : Anchor
            Where the tip must be now.
        last : ImageTip
            How that camera saw it last.
        """
        loose = _SPREAD * abs(predicted.ahead)
        point = np.empty(2)
        project_point(self.views[i].packed, predicted.motion.position, point)
        scale = self._scales[i]
        if not math.isfinite(point[0]):
            return None
        expected = Expected(
            point,
            last.direction,
            math.dist(point, self._entries[i]) - self._hole_clearance * scale,
            round(min(max((_SIDEWAYS + loose) * scale, 6.0), 20.0)),
            (_ALONG + loose) * scale if predicted.known else 0.0,
            last.contrast,
        )
        tip = None
        if predicted.known and abs(predicted.ahead) < _FOLLOW_DIRECTLY:
            on_line = dataclasses.replace(expected, search=0)
            tip = self.looks[i].fit(image, on_line, last.bright, self._detection[i])
        if tip is None:
            tip = self.looks[i].fit(image, expected, last.bright, self._detection[i])
        return None if tip is None else (tip, expected)


class HiddenEnds:
    """Lets a view that does not show the end count once, not pair by pair.

    What hides the end in one pair hides it in the next, and draws the line aside as far.
    """

    def __init__(self) -> None:
        self._pairs = [0, 0]

    def forget(self) -> None:
        """Begin anew."""
        self._pairs = [0, 0]

    def see(self, tips: tuple[ImageTip, ImageTip]) -> tuple[ImageTip, ImageTip]:
        """Return the tips, with a line across as uncertain as pairs in a row hid its end."""
        for i, tip in enumerate(tips):
            self._pairs[i] = 0 if tip.clear else self._pairs[i] + 1
        left, right = (
            dataclasses.replace(tip, sigma_across=max(pairs, 1) * tip.sigma_across)
            for tip, pairs in zip(tips, self._pairs, strict=True)
        )
        return left, right


@dataclasses.dataclass(frozen=True)
class Sights:
    """Both views' findings on the needle's end.

    Attributes
    ----------
    tips : pair of ImageTip
        Left and right, weighed.
    contradicted : bool
        Whether one of them contradicts the other and the prediction.
    """

    tips: tuple[ImageTip, ImageTip]
    contradicted: bool


@dataclasses.dataclass(frozen=True)
class Misfit:
    """Distance of a view's tip from the prediction.

    Attributes
    ----------
    across, sigma_across : float
        Across the shaft, and the standard deviation of tip and prediction [px].
    along, sigma_along, sigma_predicted : float
        Along it, and the standard deviations of tip and of prediction [m].
    """

    across: float
    sigma_across: float
    along: float
    sigma_along: float
    sigma_predicted: float


def weighed(
    views: tuple[RefractedCamera, RefractedCamera],
    tips: tuple[ImageTip, ImageTip],
    predicted: TipMotion,
) -> Sights | None:
    """Return both views' tips, with what contradicts the prediction weighing less.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    tips : pair of ImageTip
        As fitted.
    predicted : TipMotion
        Where the tip must be.

    Returns
    -------
    Sights or None
        None where neither view bears the prediction out.
    """
    left, right = (misfit(view, tip, predicted) for view, tip in zip(views, tips, strict=True))
    misfits = (left, right)
    strange = [abs(m.across) > _STRANGE * m.sigma_across for m in misfits]
    if all(strange):
        return None
    for i in range(2):
        # Two plain views that contradict the prediction: it may be what is wrong.
        if strange[i] and (not tips[1 - i].clear or is_plain(tips[i])):
            return None
    first, second = (
        tip if is_plain(tip) and not odd else _softened(tip, misfit)
        for tip, misfit, odd in zip(tips, misfits, strange, strict=True)
    )
    tips = (first, second)
    if any(strange):
        return Sights(tips, True)
    return Sights(_one_end(tips, misfits), False)


def shows_end(tip: ImageTip, across_px: float, along_px: float) -> bool:
    """Return whether a view shows the needle's end to these standard deviations [px]."""
    return (
        tip.clear
        and tip.sigma_across <= tip.allowance * across_px
        and tip.sigma_along <= tip.allowance * along_px
    )


def is_sound(tip: ImageTip) -> bool:
    """Return whether a view shows the needle's end well."""
    return shows_end(tip, SOUND_PX, SOUND_ALONG_PX)


def is_plain(tip: ImageTip) -> bool:
    """Return whether a view shows the needle's end beyond doubt."""
    return shows_end(tip, PLAIN_PX, PLAIN_ALONG_PX)


def _softened(tip: ImageTip, misfit: Misfit) -> ImageTip:
    """Return a tip that counts across the shaft as much as its distance allows (Huber's weight)."""
    distance = abs(misfit.across)
    if distance <= _ODD * misfit.sigma_across:
        return tip
    predicted = misfit.sigma_across**2 - tip.sigma_across**2
    sigma = math.sqrt(max((distance / _ODD) ** 2 - predicted, tip.sigma_across**2))
    if distance > _STRANGE * misfit.sigma_across:
        tip = dataclasses.replace(
            hidden(tip), sigma_angle=math.hypot(tip.sigma_angle, _LOOSE_ANGLE)
        )
    return dataclasses.replace(tip, sigma_across=sigma)


def _one_end(
    tips: tuple[ImageTip, ImageTip], misfits: tuple[Misfit, Misfit]
) -> tuple[ImageTip, ImageTip]:
    """Return the tips; of two ends that are apart, only the one that the prediction bears out."""
    left, right = misfits
    apart = math.hypot(left.sigma_along, right.sigma_along, SLACK)
    both = tips[0].clear and tips[1].clear
    if not both or abs(left.along - right.along) <= _STRANGE * apart:
        return tips
    nearer = min(misfits, key=lambda misfit: abs(misfit.along))
    allowed = math.hypot(nearer.sigma_along, nearer.sigma_predicted, SLACK)
    if abs(nearer.along) > _STRANGE * allowed:
        return tips
    return (tips[0], hidden(tips[1])) if nearer is left else (hidden(tips[0]), tips[1])


def misfit(view: RefractedCamera, tip: ImageTip, predicted: TipMotion) -> Misfit:
    """Return how far one view's tip is from the prediction."""
    pixel, jacobian = np.empty(2), np.empty((2, 3))
    project_point(view.packed, predicted.position, pixel)
    point_jacobian(view.packed, predicted.position, jacobian)
    covariance = predicted.covariance[:3, :3]
    along = tip.direction
    across = np.array([-along[1], along[0]])
    off = tip.point - pixel
    row = across @ jacobian
    sigma = math.sqrt(float(row @ covariance @ row) + tip.sigma_across**2)
    scale = float(along @ jacobian @ predicted.heading)
    heading = predicted.heading
    return Misfit(
        float(across @ off),
        sigma,
        float(along @ off) / scale,
        tip.sigma_along / abs(scale),
        math.sqrt(float(heading @ covariance @ heading)),
    )
