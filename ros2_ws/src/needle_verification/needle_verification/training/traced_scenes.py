"""Path-traced images to learn from, and the share of each pixel that is shaft."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.projection import project
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.path_traced.appearance import draw_appearance
from needle_sim.path_traced.insertion import trace_insertion
from needle_sim.path_traced.tracer import Mitsuba

_EXPOSURES = 6
_BEGIN, _STEP = (0.012, 0.03), (0.010, 0.015)  # insertions are drawn from these [m]
_FINE, _SUBPIXEL_BITS = 4, 4  # points across a pixel, and bits of a corner's place
_SIDEWAYS = 1e-4  # for the shaft's width in pixels [m]


@dataclasses.dataclass(frozen=True, eq=False)
class TracedScene:
    """One needle at several insertions, as both cameras see it.

    Attributes
    ----------
    images : ndarray of uint8, shape (n, height, width)
        As the cameras have them.
    shares : ndarray of uint8, shape (n, height, width)
        255 times the share of each pixel that is shaft, cut straight at the end of its axis.
    ends : ndarray, shape (n, 2)
        Where that is [px]; NaN where there is no needle.
    width_px : float
        Of the needle in the images [px].
    """

    images: NDArray[np.uint8]
    shares: NDArray[np.uint8]
    ends: NDArray[np.float64]
    width_px: float


def trace_scene(mitsuba: Mitsuba, rig: StereoRig, seed: int, plain_width_px: float) -> TracedScene:
    """Trace one scene at random.

    Parameters
    ----------
    mitsuba : Mitsuba
        As `load_mitsuba` gives it.
    rig : StereoRig
        Cameras and phantom.
    seed : int
        Keys all that is random.
    plain_width_px : float
        What a needle's width is taken for where there is none [px].
    """
    look = draw_appearance("random", seed)
    rng = np.random.default_rng(seed)
    begin, step = float(rng.uniform(*_BEGIN)), float(rng.uniform(*_STEP))
    depth = begin + step * (_EXPOSURES - 1)
    images, shares, ends, width = [], [], [], plain_width_px
    pairs = trace_insertion(
        mitsuba, rig, look, frames=_EXPOSURES, depth=depth, step=step, begin=begin
    )
    for pair in pairs:
        for side, (camera, image) in enumerate(
            zip((rig.left, rig.right), pair.images, strict=True)
        ):
            share, end = np.zeros_like(image), np.full(2, np.nan)
            if pair.meshes is not None:
                line = pair.meshes[side].line
                line = line[line[:, 2] > 0.0]
                share, end, width = _shaft(line, look.diameter, camera, rig)
            images.append(image)
            shares.append(share)
            ends.append(end)
    return TracedScene(np.stack(images), np.stack(shares), np.stack(ends), width)


def _shaft(
    line: NDArray[np.float64], diameter: float, camera: SimulatedCamera, rig: StereoRig
) -> tuple[NDArray[np.uint8], NDArray[np.float64], float]:
    """Return 255 times the share of each pixel, the end and the width [px]."""

    def seen(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(project(points, camera))

    middle = seen(line)
    ahead = np.gradient(line, axis=0)
    beside = np.cross(ahead / np.linalg.norm(ahead, axis=1, keepdims=True), [1.0, 0.0, 0.0])
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    px_per_m = np.linalg.norm(seen(line + _SIDEWAYS * beside) - middle, axis=1) / _SIDEWAYS
    along = np.gradient(middle, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    half = 0.5 * diameter * px_per_m[:, None] * np.stack([-along[:, 1], along[:, 0]], axis=1)
    corners = (np.concatenate([middle + half, (middle - half)[::-1]]) + 0.5) * _FINE - 0.5
    height, width = camera.image_height, camera.image_width
    fine = np.zeros((height * _FINE, width * _FINE), np.uint8)
    places = np.rint(corners * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.fillPoly(fine, [places], 255, cv2.LINE_8, _SUBPIXEL_BITS)
    share = np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return share, middle[-1], float(np.median(px_per_m) * diameter)
