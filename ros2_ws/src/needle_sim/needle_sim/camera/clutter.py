"""Clutter around the needle: bubbles, cable, floor shadow, hands, covered lenses, graph paper."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import erf

from needle_sim.camera.optics import FloatImage, Optics
from needle_sim.camera.scenarios import Bubbles, FloorShadow
from needle_sim.camera.stereo_rig import StereoRig
from needle_sim.needle.se3 import FloatArray

# Range of the bubbles: depth below the top, maximum offset to the sides, length [m].
_DEPTHS = (0.0012, 0.0345)
_BUBBLE_SIDE = 0.055
_BUBBLE_LENGTHS = (0.006, 0.150)
# Total reflection makes the rim of a bubble dark; the lamp causes a bright spot.
_RIM_SHARE = 0.62
_RIM_GAIN = 0.42
_MIDDLE_GAIN = 0.93
_SPOT = 110.0
_SPOT_PLACE = (-0.38, -0.30)
_SPOT_SIZE = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class BubbleCloud:
    """Air bubbles in the phantom.

    Attributes
    ----------
    centre : ndarray, shape (N, 3)
        Centres in `rig` [m].
    radius : ndarray, shape (N,)
        Radii [m].
    """

    centre: FloatArray
    radius: FloatArray


@dataclasses.dataclass(frozen=True, eq=False)
class BubbleImage:
    """Effect of bubbles on a camera's image; all arrays have the shape of the image.

    Attributes
    ----------
    gain, added : ndarray of float32
        The bubbles change the light behind them to light * `gain` + `added` [grey levels].
    height : ndarray of float32
        Height of the highest bubble at the pixel, towards the camera; -inf without bubble [m].
    """

    gain: FloatImage
    added: FloatImage
    height: FloatImage


def place_bubbles(bubbles: Bubbles, rig: StereoRig, rng: np.random.Generator) -> BubbleCloud:
    """Return random bubbles, uniform in the phantom and in the logarithm of their radius."""
    side = min(_BUBBLE_SIDE, rig.half_width)
    low = [rig.half_height - _DEPTHS[1], -side, _BUBBLE_LENGTHS[0]]
    high = [rig.half_height - _DEPTHS[0], side, _BUBBLE_LENGTHS[1]]
    centre = rng.uniform(low, high, (bubbles.count, 3))
    size = rng.uniform(np.log(bubbles.smallest), np.log(bubbles.largest), bubbles.count)
    radius = np.exp(size)
    # Keep the bubbles behind the windows.
    for camera in (rig.left, rig.right):
        window = camera.window
        out = np.maximum(window.height(centre) - (window.inner - 1.2 * radius), 0.0)
        centre -= out[:, np.newaxis] * window.normal
    return BubbleCloud(centre, radius)


def draw_bubbles(cloud: BubbleCloud, optics: Optics) -> BubbleImage:
    """Return the image of the bubbles in a camera."""
    width, height = optics.image_size
    image = BubbleImage(
        np.ones((height, width), dtype=np.float32),
        np.zeros((height, width), dtype=np.float32),
        np.full((height, width), -np.inf, dtype=np.float32),
    )
    centres = optics.project(cloud.centre)
    radii = optics.radius_px(cloud.centre, cloud.radius)
    blurs = np.broadcast_to(optics.blur_px(cloud.centre), radii.shape)
    heights = optics.window.height(cloud.centre)
    # From the bottom up, because higher bubbles hide lower ones.
    for i in np.argsort(heights):
        radius, blur = float(radii[i]), float(blurs[i])
        reach = int(np.ceil(radius + 3.0 * blur))
        column, row = (round(float(part)) for part in centres[i])
        rows = slice(max(row - reach, 0), min(row + reach + 1, height))
        columns = slice(max(column - reach, 0), min(column + reach + 1, width))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            continue
        u = np.arange(columns.start, columns.stop) - centres[i, 0]
        v = (np.arange(rows.start, rows.stop) - centres[i, 1])[:, np.newaxis]
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
    # A disk of the size of its blur loses contrast.
    strength = 1.0 - np.exp(-((radius / blur) ** 2) / 2.0)
    disk = 0.5 * strength * (1.0 - erf((distance - radius) * scale))
    middle = 0.5 * strength * (1.0 - erf((distance - _RIM_SHARE * radius) * scale))
    gain = 1.0 - (1.0 - _RIM_GAIN) * disk + (_MIDDLE_GAIN - _RIM_GAIN) * middle
    spread = np.hypot(_SPOT_SIZE * radius, blur)
    from_spot = np.hypot(u - _SPOT_PLACE[0] * radius, v - _SPOT_PLACE[1] * radius)
    share = (_SPOT_SIZE * radius / spread) ** 2
    return gain, 3.0 * share * _SPOT * np.exp(-0.5 * (from_spot / spread) ** 2)


CABLE_DIAMETER = 0.0007
"""Diameter of the cable, similar to the needle's [m]."""
# Height above the surface, amplitude across the needle [m], period [exposures].
_CABLE_HEIGHT, _CABLE_SWAY, _CABLE_PERIOD = 0.003, 0.022, 70.0
_CABLE_POINTS = 120
_CABLE_HALF_LENGTH = 0.075
_CABLE_MIDDLE = 0.07

# Hand as capsules in a plane, pointing along +a: (a0, b0, a1, b1, radius), palm at 0 [m].
_HAND = (
    (-0.30, 0.01, -0.06, 0.0, 0.034),
    (-0.06, 0.0, 0.0, 0.0, 0.036),
    (-0.01, -0.024, 0.044, -0.034, 0.0095),
    (-0.005, -0.009, 0.056, -0.012, 0.010),
    (-0.005, 0.009, 0.054, 0.010, 0.010),
    (-0.01, 0.024, 0.042, 0.032, 0.009),
    (-0.03, 0.028, 0.015, 0.056, 0.011),
)
_FAR = 0.26
_HIGH = 0.18
_LOW = 0.03


def cable_line(surface_height: float, exposure_number: int, rng: np.random.Generator) -> FloatArray:
    """Return the line of the cable at an exposure.

    Parameters
    ----------
    surface_height : float
        x of the phantom's surface in `rig` [m].
    exposure_number : int
        Number of the exposure.
    rng : numpy.random.Generator
        Generator in the same state for every exposure of a run.

    Returns
    -------
    ndarray, shape (M, 3)
        Centreline in `rig` [m].
    """
    phases = rng.uniform(0.0, 2.0 * np.pi, 4)
    paces = rng.uniform(0.8, 1.25, 4)
    half_length = _CABLE_HALF_LENGTH * rng.uniform(0.4, 1.0)
    sway, turn, slide, bow = np.sin(
        2.0 * np.pi * exposure_number / _CABLE_PERIOD * paces + phases
    ).tolist()
    angle = 0.5 * turn
    along = np.linspace(-half_length, half_length, _CABLE_POINTS)
    across = 0.006 * bow * (1.0 - (along / half_length) ** 2)
    line = np.empty((_CABLE_POINTS, 3))
    line[:, 0] = surface_height + _CABLE_HEIGHT
    line[:, 1] = _CABLE_SWAY * sway + np.sin(angle) * along + np.cos(angle) * across
    line[:, 2] = _CABLE_MIDDLE + 0.03 * slide + np.cos(angle) * along - np.sin(angle) * across
    return line


def shadow_line(
    shadow: FloorShadow, surface_height: float, line: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the shadow of a line on the phantom's floor in parallel light.

    Parameters
    ----------
    shadow : FloorShadow
        Properties of the shadow.
    surface_height : float
        x of the phantom's surface in `rig` [m].
    line : ndarray, shape (M, 3)
        Line that casts the shadow, in `rig` [m].
    rng : numpy.random.Generator
        Generator in the same state for every exposure of a run.

    Returns
    -------
    shadow_line : ndarray, shape (M, 3)
        Centreline of the shadow in `rig` [m].
    fall : ndarray, shape (M,)
        Height of each point of the line above the floor [m].
    """
    slant = rng.uniform(-shadow.largest_slant, shadow.largest_slant, 2)
    floor = surface_height - shadow.floor_depth
    fall = np.maximum(line[:, 0] - floor, 0.0)
    cast = np.empty_like(line)
    cast[:, 0] = floor
    cast[:, 1:] = line[:, 1:] + fall[:, np.newaxis] * slant
    return cast, fall


@dataclasses.dataclass(frozen=True)
class OcclusionEvent:
    """Obstruction of the view at an exposure.

    Attributes
    ----------
    blocks : pair of bool
        Whether it affects the left and the right camera.
    covered : bool
        Whether it covers the lens; otherwise it is a passing hand.
    progress : float
        Progress of the event, 0 to 1.
    """

    blocks: tuple[bool, bool]
    covered: bool
    progress: float


# First exposure that may be affected, period, duration for one and for both cameras [exposures].
_FIRST_EVENT, _EVENT_PERIOD, _EVENT_LENGTH, _EVENT_LENGTH_BOTH = 20, 40, 14, 6


def occlusion_at(seed: int, exposure_number: int) -> OcclusionEvent | None:
    """Return the obstruction at an exposure; None without one."""
    if exposure_number < _FIRST_EVENT:
        return None
    period, within = divmod(exposure_number - _FIRST_EVENT, _EVENT_PERIOD)
    # Each group of three periods has left, right and both in random order, by hand or cover.
    round_, place = divmod(period, 3)
    order = np.random.default_rng([seed, round_, 8]).permutation(3)
    rng = np.random.default_rng([seed, period, 9])
    blocks = ((True, False), (False, True), (True, True))[int(order[place])]
    length = _EVENT_LENGTH_BOTH if all(blocks) else _EVENT_LENGTH
    begin = int(rng.integers(0, _EVENT_PERIOD - length + 1))
    covered = bool(rng.random() < 0.4)
    if not begin <= within < begin + length:
        return None
    return OcclusionEvent(blocks, covered, (within - begin + 0.5) / length)


def hand_capsules(
    event: OcclusionEvent, target: FloatArray, rig: StereoRig
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Return a hand that passes over the target and back.

    High above the window it blocks the line of sight of one camera; low, that of both.

    Parameters
    ----------
    event : OcclusionEvent
        Affected cameras, and progress.
    target : ndarray, shape (3,)
        Point that it passes over, in `rig` [m].
    rig : StereoRig
        Rig with the cameras.

    Returns
    -------
    list of (ndarray (3,), ndarray (3,), float)
        Capsules: end points in `rig`, and radius [m].
    """
    middle = (rig.left.centre + rig.right.centre) / 2.0
    if all(event.blocks):
        centre, height = middle, _LOW
        normal = rig.left.window.normal + rig.right.window.normal
        normal = normal / np.linalg.norm(normal)
        sideways = np.cross([0.0, 0.0, 1.0], normal)
    else:
        camera = rig.left if event.blocks[0] else rig.right
        centre, height = camera.centre, _HIGH
        normal, sideways = camera.window.normal, camera.window.sideways
    side = 0.0 if all(event.blocks) else float(np.sign((centre - middle) @ sideways))
    over = target + height / float((centre - target) @ normal) * (centre - target)
    # From the side of the blocked camera, so that the arm does not block the other one.
    forward = -side * sideways if side else sideways
    aside = np.array([0.0, 0.0, 1.0])
    # Fast in and out, with a pause over the target.
    reached = min(1.0, 1.6 * np.sin(np.pi * event.progress))
    over = over - (1.0 - reached) * _FAR * forward
    return [
        (
            over + a0 * forward + b0 * aside,
            over + a1 * forward + b1 * aside,
            radius,
        )
        for a0, b0, a1, b1, radius in _HAND
    ]


PAPER_LINE_WIDTH, PAPER_GREY = 0.0004, 95.0
"""Width [m] and brightness [grey levels] of the paper's lines."""
# Depth of the paper under the surface, and spacing of its lines [m].
_PAPER_DEPTH, _PAPER_PITCH = 0.035, 0.005
_PAPER_LENGTHS, _PAPER_SIDES = (-0.02, 0.16), (-0.07, 0.07)
_POINTS = 60
_LARGEST_TURN = 0.35


def paper_lines(half_height: float, rng: np.random.Generator) -> list[FloatArray]:
    """Return the lines of graph paper under the phantom, each (M, 3) in `rig` [m].

    Parameters
    ----------
    half_height : float
        Distance from the needle's entry to the phantom's surface [m].
    rng : numpy.random.Generator
        Generator for its random pose.
    """
    turn, aside, ahead = rng.uniform(-_LARGEST_TURN, _LARGEST_TURN), *rng.uniform(0.0, 1.0, 2)
    along = np.array([0.0, np.sin(turn), np.cos(turn)])
    across = np.array([0.0, np.cos(turn), -np.sin(turn)])
    middle = np.array([half_height - _PAPER_DEPTH, 0.0, float(np.mean(_PAPER_LENGTHS))])
    reach = float(np.hypot(np.ptp(_PAPER_LENGTHS), np.ptp(_PAPER_SIDES))) / 2.0
    count = int(reach / _PAPER_PITCH)
    places = np.linspace(-reach, reach, _POINTS)[:, np.newaxis]
    lines = []
    for k in range(-count, count + 1):
        for direction, beside, offset in ((along, across, aside), (across, along, ahead)):
            line = middle + (k + offset) * _PAPER_PITCH * beside + places * direction
            inside = (line[:, 2] > _PAPER_LENGTHS[0]) & (line[:, 2] < _PAPER_LENGTHS[1])
            inside &= (line[:, 1] > _PAPER_SIDES[0]) & (line[:, 1] < _PAPER_SIDES[1])
            if inside.sum() > 1:
                lines.append(line[inside])
    return lines
