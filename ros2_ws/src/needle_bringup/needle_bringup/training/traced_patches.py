"""Samples from path-traced images, with random rotation, scale and camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.needle_ends import (
    Pose,
    drawn_tracks,
    faded,
    made_faint,
    shifted_tracks,
)
from needle_bringup.training.samples import (
    CANVAS,
    SIZE,
    WITH_BACKGROUND,
    Sample,
    exposed,
    random_width,
)
from needle_bringup.training.traced_scenes import TracedScene

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_AT_END, _ON_SHAFT = 0.55, 0.25  # probabilities of the centre; otherwise anywhere
_BESIDE_PX = 0.4 * SIZE  # maximum distance of the subject from the centre
_LARGEST = 1.8  # maximum scale; a larger one would only blur the image
_SMALLER, _BLUR = (
    0.8,
    0.45,
)  # scale below which images are blurred first, and the blur in new pixels
_TRACKS, _OF_NEEDLE = 0.4, 0.6  # probability of old tracks in a patch; of traced ones among them
_DARK = 8.0  # grey levels added before taking ratios of dark pixels


@dataclasses.dataclass(frozen=True, eq=False)
class Cut:
    """Position, scale and rotation of a patch in an image.

    Attributes
    ----------
    place : ndarray, shape (2,)
        Column and row of the centre [px].
    scale : float
        Pixels of the patch per pixel of the image.
    angle : float
        Rotation of the patch [rad].
    """

    place: Array
    scale: float
    angle: float

    def point(self, point: Array) -> Array:
        """Return the position of an image point in the patch [px]."""
        return np.asarray(self._turn() @ (point - self.place) + 0.5 * (CANVAS - 1))

    def image(self, image: NDArray[np.uint8]) -> Image:
        """Return the patch from an image, (CANVAS, CANVAS), mirrored beyond the edges."""
        reach = int(0.75 * CANVAS / self.scale) + 8
        corner = np.rint(self.place).astype(int) - reach
        low = np.clip(corner, 0, None)
        high = np.maximum(np.rint(self.place).astype(int) + reach, low + 1)
        part = image[low[1] : high[1], low[0] : high[0]]
        if self.scale < _SMALLER:
            part = cv2.GaussianBlur(part, (0, 0), _BLUR / self.scale)
        turn = self._turn()
        to = np.column_stack([turn, np.full(2, 0.5 * (CANVAS - 1)) - turn @ (self.place - low)])
        cut = cv2.warpAffine(
            part.astype(np.float32), to, (CANVAS, CANVAS), borderMode=cv2.BORDER_REFLECT
        )
        return np.asarray(cut, np.float32)

    def _turn(self) -> Array:
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return self.scale * np.array([[cos, -sin], [sin, cos]])


def traced_patch(rng: np.random.Generator, scenes: Sequence[TracedScene]) -> Sample:
    """Return a random sample from the scenes.

    Parameters
    ----------
    rng : Generator
        Random generator.
    scenes : sequence of TracedScene
        The scenes.
    """
    width = random_width(rng)
    for _ in range(8):
        scene = scenes[int(rng.integers(len(scenes)))]
        i = int(rng.integers(len(scene.images)))
        scale = width / scene.widths_px[i]
        if scale < _LARGEST:
            break
    else:
        scale = _LARGEST
    place = _place(rng, scene, i) + rng.uniform(-_BESIDE_PX, _BESIDE_PX, 2) / scale
    cut = Cut(place, scale, float(rng.uniform(0.0, 2.0 * np.pi)))
    image, share = cut.image(scene.images[i]), cut.image(scene.shares[i])
    known = rng.random() < WITH_BACKGROUND
    before = cut.image(scene.images[_earlier(rng, i, len(scene.images))]) if known else None
    if rng.random() < _TRACKS:
        tracks = _tracks(rng, scene, i, cut, faint=not known)
        # In most cases, the needle covers the tracks.
        uncovered = np.float32(1.0) - (share / np.float32(255.0)) * (rng.random() < 0.7)
        image = image * (1.0 + (tracks - 1.0) * uncovered)
        before = None if before is None else before * shifted_tracks(rng, tracks)
    seen, background = exposed(rng, image, before)
    end = cut.point(scene.ends[i])
    return Sample(seen, background, np.rint(share).astype(np.uint8), end)


def _earlier(rng: np.random.Generator, i: int, count: int) -> int:
    """Return the index of a background of the same camera: no needle, a shorter or a longer one."""
    others = np.arange(i % 2, count, 2)
    longer, shorter = others[others > i], others[(others < i) & (others > 1)]
    chance = rng.random()
    if chance < 0.12 and len(longer):
        return int(rng.choice(longer))
    if chance < 0.5 and len(shorter):
        return int(rng.choice(shorter))
    # Rarely use the image as its own background, as for views never recorded without the needle.
    return i if 0.5 <= chance < 0.53 else i % 2


def _tracks(
    rng: np.random.Generator, scene: TracedScene, i: int, cut: Cut, *, faint: bool
) -> Image:
    """Return the factor by which old tracks change the brightness of each pixel of a patch."""
    if rng.random() > _OF_NEEDLE:
        end = cut.point(scene.ends[i])
        if not np.isfinite(end).all():
            end = rng.uniform(0.0, CANVAS, 2)
        radius = 0.5 * cut.scale * float(scene.widths_px[i])
        heading = rng.uniform(0.0, 2.0 * np.pi)
        return drawn_tracks(
            rng, Pose(float(end[0]), float(end[1]), heading, 0.0, 0.0, radius), CANVAS, faint=faint
        )
    # Use a traced needle of the same scene at another place as a track.
    k = int(rng.integers(2, len(scene.images)))
    if rng.random() < 0.35 and k % 2 == i % 2:
        nudge = rng.normal(0.0, 3.0, 2) / cut.scale
        other = Cut(cut.place + nudge, cut.scale, cut.angle + rng.normal(0.0, 0.03))
    else:
        place = _place(rng, scene, k) + rng.uniform(-_BESIDE_PX, _BESIDE_PX, 2) / cut.scale
        other = Cut(place, cut.scale * rng.uniform(0.7, 1.2), rng.uniform(0.0, 2.0 * np.pi))
    with_needle, empty = (other.image(scene.images[n]) for n in (k, k % 2))
    factor = np.clip((with_needle + _DARK) / (empty + _DARK), 0.1, 4.0)
    blur = float(rng.choice([0.0, 0.0, 0.8, 2.0])) + (1.0 if faint else 0.0)
    factor = faded(factor, rng.uniform(0.3, 1.1), blur)
    return made_faint(factor) if faint else np.asarray(factor.clip(min=0.05), np.float32)


def _place(rng: np.random.Generator, scene: TracedScene, i: int) -> Array:
    """Return the position of a patch's subject in an image [px]."""
    chance, end = rng.random(), scene.ends[i]
    if chance < _AT_END and np.isfinite(end).all():
        return np.asarray(end)
    if chance < _AT_END + _ON_SHAFT:
        rows, columns = np.nonzero(scene.shares[i] > 128)
        if len(rows):
            k = int(rng.integers(len(rows)))
            return np.array([columns[k], rows[k]], np.float64)
    height, width = scene.images.shape[1:]
    return np.asarray(rng.uniform(0.0, 1.0, 2) * [width, height])
