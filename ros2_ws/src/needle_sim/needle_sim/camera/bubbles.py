"""Air bubbles in the phantom: where they are, and how a camera sees them."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import erf

from needle_sim.camera.optics import FloatImage, Optics
from needle_sim.camera.scenarios import Bubbles
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.needle.se3 import FloatArray

# Where bubbles are: below the top by, to both sides of the needle by at most, along it [m].
_DEPTHS = (0.0012, 0.0345)
_SIDE = 0.055
_LENGTHS = (0.006, 0.150)
# A bubble in a denser medium: total reflection makes its rim dark, the lamp a spot on it.
_RIM_SHARE = 0.62
_RIM_GAIN = 0.42
_MIDDLE_GAIN = 0.93
_SPOT = 110.0
_SPOT_PLACE = (-0.38, -0.30)
_SPOT_SIZE = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class BubbleCloud:
    """Spheres of air.

    Attributes
    ----------
    centre : ndarray, shape (N, 3)
        In `rig` [m].
    radius : ndarray, shape (N,)
        [m].
    """

    centre: FloatArray
    radius: FloatArray


@dataclasses.dataclass(frozen=True, eq=False)
class BubbleImage:
    """Effect of bubbles on one camera's image; all of the image's shape.

    Attributes
    ----------
    gain, added : ndarray of float32
        The light behind times `gain` plus `added` [grey levels].
    height : ndarray of float32
        Of the highest bubble at the pixel, towards the camera; -inf where there is none [m].
    """

    gain: FloatImage
    added: FloatImage
    height: FloatImage


def place_bubbles(bubbles: Bubbles, rig: StereoRig, rng: np.random.Generator) -> BubbleCloud:
    """Return where the bubbles are, uniform in the phantom, twice the size half as frequent."""
    side = min(_SIDE, rig.half_width)
    low = [rig.half_height - _DEPTHS[1], -side, _LENGTHS[0]]
    high = [rig.half_height - _DEPTHS[0], side, _LENGTHS[1]]
    centre = rng.uniform(low, high, (bubbles.count, 3))
    size = rng.uniform(np.log(bubbles.smallest), np.log(bubbles.largest), bubbles.count)
    radius = np.exp(size)
    # None sticks out of a window.
    for camera in (rig.left, rig.right):
        window = camera.window
        out = np.maximum(window.height(centre) - (window.inner - 1.2 * radius), 0.0)
        centre -= out[:, np.newaxis] * window.normal
    return BubbleCloud(centre, radius)


def draw_bubbles(cloud: BubbleCloud, optics: Optics) -> BubbleImage:
    """Return what one camera sees of the bubbles."""
    width, height = optics.image_size
    image = BubbleImage(
        np.ones((height, width), dtype=np.float32),
        np.zeros((height, width), dtype=np.float32),
        np.full((height, width), -np.inf, dtype=np.float32),
    )
    middles = optics.project(cloud.centre)
    radii = optics.radius_px(cloud.centre, cloud.radius)
    blurs = np.broadcast_to(optics.blur_px(cloud.centre), radii.shape)
    heights = optics.window.height(cloud.centre)
    # From the bottom up: higher ones hide what is under them.
    for i in np.argsort(heights):
        radius, blur = float(radii[i]), float(blurs[i])
        reach = int(np.ceil(radius + 3.0 * blur))
        column, row = (round(float(part)) for part in middles[i])
        rows = slice(max(row - reach, 0), min(row + reach + 1, height))
        columns = slice(max(column - reach, 0), min(column + reach + 1, width))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            continue
        u = np.arange(columns.start, columns.stop) - middles[i, 0]
        v = (np.arange(rows.start, rows.stop) - middles[i, 1])[:, np.newaxis]
        gain, added = _one_bubble(u, v, radius, blur)
        part = (rows, columns)
        image.gain[part] *= gain
        image.added[part] = image.added[part] * gain + added
        inside = u * u + v * v < (radius + blur) ** 2
        image.height[part][inside] = heights[i]
    return image


def _one_bubble(
    u: FloatArray, v: FloatArray, radius: float, blur: float
) -> tuple[FloatArray, FloatArray]:
    distance = np.hypot(u, v)
    scale = 1.0 / (np.sqrt(2.0) * blur)
    # Of a disk no larger than its blur, only part is left.
    strength = 1.0 - np.exp(-((radius / blur) ** 2) / 2.0)
    disk = 0.5 * strength * (1.0 - erf((distance - radius) * scale))
    middle = 0.5 * strength * (1.0 - erf((distance - _RIM_SHARE * radius) * scale))
    gain = 1.0 - (1.0 - _RIM_GAIN) * disk + (_MIDDLE_GAIN - _RIM_GAIN) * middle
    spread = np.hypot(_SPOT_SIZE * radius, blur)
    from_spot = np.hypot(u - _SPOT_PLACE[0] * radius, v - _SPOT_PLACE[1] * radius)
    share = (_SPOT_SIZE * radius / spread) ** 2
    return gain, 3.0 * share * _SPOT * np.exp(-0.5 * (from_spot / spread) ** 2)
