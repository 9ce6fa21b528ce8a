"""Samples of drawn scenes with a floor, clutter, old tracks, and a needle with its shadow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_bringup.training.floors import clutter, floor
from needle_bringup.training.needle_ends import (
    Pose,
    draw_needle,
    draw_shadow,
    drawn_tracks,
    random_pose,
    shifted_tracks,
    true_map,
)
from needle_bringup.training.samples import CANVAS, WITH_BACKGROUND, Sample, exposed, random_width

Image = NDArray[np.float32]
_THERE, _SHADOW, _TRACKS, _TORN = 0.75, 0.6, 0.4, 0.15  # probabilities
_LONGER = 0.1  # probability of a deeper needle in the background
_SEED = 2**32


def patch(rng: np.random.Generator) -> Sample:
    """Return a drawn sample.

    Parameters
    ----------
    rng : Generator
        Random generator.
    """
    width = random_width(rng)
    pose = random_pose(rng, CANVAS, 0.5 * width)
    known = rng.random() < WITH_BACKGROUND
    image = before = floor(rng, CANVAS)
    if rng.random() < _TRACKS:
        tracks = drawn_tracks(rng, pose, CANVAS, faint=not known)
        image, before = image * tracks, before * shifted_tracks(rng, tracks)
    if rng.random() < 0.5:
        image, before = _alike(rng, image, before)
    there = rng.random() < _THERE
    needle, shadow = (int(seed) for seed in rng.integers(_SEED, size=2))
    casts = rng.random() < _SHADOW
    if rng.random() < 0.2:  # new dust
        image = clutter(rng, image)
    image = _with(image, pose, needle if there else None, shadow if casts else None)
    if there and rng.random() < _TORN:
        image = _torn(rng, image, pose)
    if known:
        earlier = _earlier(rng, pose, there)
        if earlier is not None:
            before = _with(before, earlier, needle, shadow if casts else None)
    if rng.random() < 0.3:
        image, before = _alike(rng, image, before)
    photo, background = exposed(rng, image, before if known else None)
    share = np.zeros((CANVAS, CANVAS), np.uint8)
    end = np.full(2, np.nan)
    if there:
        share = np.rint(255.0 * true_map(pose, CANVAS)).astype(np.uint8)
        end = np.array([pose.x, pose.y])
    return Sample(photo, background, share, end)


def _alike(rng: np.random.Generator, image: Image, before: Image) -> tuple[Image, Image]:
    """Draw the same clutter in front of both images."""
    seed = int(rng.integers(_SEED))
    one, other = (clutter(np.random.default_rng(seed), each) for each in (image, before))
    return one, other


def _with(image: Image, pose: Pose, needle: int | None, shadow: int | None) -> Image:
    """Return an image with a needle and its shadow, each drawn only if its seed is given."""
    if shadow is not None:
        image = draw_shadow(np.random.default_rng(shadow), image, pose)
    if needle is not None:
        image = draw_needle(np.random.default_rng(needle), image, pose)
    return image


def _earlier(rng: np.random.Generator, pose: Pose, there: bool) -> Pose | None:
    """Return the pose of the needle in the background; None if there is no needle."""
    chance = rng.random()
    back = float(np.exp(rng.uniform(np.log(1.0), np.log(90.0))))
    if chance < _LONGER:
        return pose.slid(back)
    return pose.slid(-back) if there and chance < 0.5 else None


def _torn(rng: np.random.Generator, image: Image, pose: Pose) -> Image:
    """Return an image with clouded gel around the needle, up to its end or slightly beyond."""
    ahead = pose.slid(rng.uniform(-5.0, 5.0))
    soft = cv2.GaussianBlur(
        true_map(ahead, len(image)), (0, 0), pose.radius * rng.uniform(0.8, 2.5)
    )
    return np.asarray(image * (1.0 + rng.uniform(-0.35, 0.35) * soft), np.float32)
