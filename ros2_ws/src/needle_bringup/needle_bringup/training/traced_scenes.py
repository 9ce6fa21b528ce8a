"""Path-traced images to learn from, and the share of each pixel that is shaft."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_sim.camera.optics import project
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.path_traced.appearance import draw_appearance
from needle_sim.path_traced.insertion import trace_insertion
from needle_sim.path_traced.tracer import Mitsuba

_EXPOSURES = 6
# Insertions are drawn from these [m]; a short step shows what a needle's first new part looks like.
_BEGIN, _STEP = (0.005, 0.03), (0.002, 0.008)
_FINE, _SUBPIXEL_BITS = 4, 4  # points across a pixel, and bits of a corner's place
_SIDEWAYS = 1e-4  # for the shaft's width in pixels [m]


@dataclasses.dataclass(frozen=True, eq=False)
class TracedScene:
    """The phantom without a needle, then with one at several insertions, as both cameras see it.

    Attributes
    ----------
    images : ndarray of uint8, shape (n, height, width)
        As the cameras have them, left and right in turn.
    shares : ndarray of uint8, shape (n, height, width)
        255 times the share of each pixel that is shaft, cut straight at the end of its axis.
    ends : ndarray, shape (n, 2)
        Where that is [px]; NaN where there is no needle in the image.
    widths_px : ndarray, shape (n,)
        Of the needle in each, or where it will be in the phantom without one [px].
    """

    images: NDArray[np.uint8]
    shares: NDArray[np.uint8]
    ends: NDArray[np.float64]
    widths_px: NDArray[np.float64]


def trace_scene(mitsuba: Mitsuba, rig: StereoRig, seed: int) -> TracedScene:
    """Trace one scene at random.

    Parameters
    ----------
    mitsuba : Mitsuba
        As `load_mitsuba` gives it.
    rig : StereoRig
        Cameras and phantom.
    seed : int
        Keys all that is random.
    """
    look = draw_appearance("random", seed)
    rng = np.random.default_rng(seed)
    begin, step = float(rng.uniform(*_BEGIN)), float(rng.uniform(*_STEP))
    depth = begin + step * (_EXPOSURES - 1)
    images, shares, ends, widths = [], [], [], []
    pairs = trace_insertion(
        mitsuba,
        rig,
        look,
        frames=_EXPOSURES,
        depth=depth,
        step=step,
        begin=begin,
        empty_first=True,
    )
    for pair in pairs:
        for side, (camera, image) in enumerate(
            zip((rig.left, rig.right), pair.images, strict=True)
        ):
            share, end, width = np.zeros_like(image), np.full(2, np.nan), np.nan
            if pair.meshes is not None:
                line = pair.meshes[side].line
                line = line[line[:, 2] > 0.0]
                share, end, width = shaft_share(line, look.diameter, camera)
            images.append(image)
            shares.append(share)
            ends.append(end)
            widths.append(width)
    widths[:2] = widths[2:4]
    return TracedScene(np.stack(images), np.stack(shares), np.stack(ends), np.array(widths))


def shaft_share(
    line: NDArray[np.float64], diameter: float, camera: SimulatedCamera
) -> tuple[NDArray[np.uint8], NDArray[np.float64], float]:
    """Return where a camera sees a needle's shaft.

    Parameters
    ----------
    line : ndarray, shape (n, 3)
        Its axis, outwards, in `rig` [m].
    diameter : float
        Of it [m].
    camera : SimulatedCamera
        Which sees it.

    Returns
    -------
    share : ndarray of uint8, shape (height, width)
        255 times the share of each pixel, cut straight at the end of the axis.
    end : ndarray, shape (2,)
        Where that is [px]; NaN outside the image.
    width_px : float
        Of the shaft, in the median [px].
    """

    def seen(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(project(points, camera))

    middle = seen(line)
    along = np.gradient(middle, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    ahead = np.gradient(line, axis=0)
    # Of a round shaft each camera sees the two sides that are across its own line of sight.
    one = np.cross(ahead, [1.0, 0.0, 0.0])
    moved = [
        np.sum((seen(line + _SIDEWAYS * side / _norm(side)) - middle) * across, axis=1)
        for side in (one, np.cross(ahead, one))
    ]
    px_per_m = np.hypot(*moved) / _SIDEWAYS
    half = 0.5 * diameter * px_per_m[:, None] * across
    corners = (np.concatenate([middle + half, (middle - half)[::-1]]) + 0.5) * _FINE - 0.5
    height, width = camera.image_height, camera.image_width
    fine = np.zeros((height * _FINE, width * _FINE), np.uint8)
    places = np.rint(corners * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.fillPoly(fine, [places], 255, cv2.LINE_8, _SUBPIXEL_BITS)
    share = np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    end = middle[-1]
    if (end < 0.0).any() or (end > [width - 1.0, height - 1.0]).any():
        end = np.full(2, np.nan)
    return share, end, float(np.median(px_per_m) * diameter)


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(vectors, axis=1, keepdims=True))
