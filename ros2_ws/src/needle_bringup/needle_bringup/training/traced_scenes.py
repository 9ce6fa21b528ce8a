"""Path-traced training images, and the share of each pixel that belongs to the shaft."""

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
# Ranges of the first insertion and of the step [m].
_BEGIN, _STEP = (0.005, 0.03), (0.002, 0.008)
_FINE, _SUBPIXEL_BITS = 4, 4  # sub-pixels across a pixel, and fractional bits of a corner
_SIDEWAYS = 1e-4  # sideways step to compute the shaft's width in pixels [m]


@dataclasses.dataclass(frozen=True, eq=False)
class TracedScene:
    """Images of both cameras without a needle, then at several insertions.

    Attributes
    ----------
    images : ndarray of uint8, shape (n, height, width)
        Camera images, alternating left and right.
    shares : ndarray of uint8, shape (n, height, width)
        255 times the share of each pixel that belongs to the shaft, cut straight at its end.
    ends : ndarray, shape (n, 2)
        Ends of the shaft [px]; NaN if outside the image.
    widths_px : ndarray, shape (n,)
        Needle width in each image [px], also given for images without a needle.
    """

    images: NDArray[np.uint8]
    shares: NDArray[np.uint8]
    ends: NDArray[np.float64]
    widths_px: NDArray[np.float64]


def trace_scene(mitsuba: Mitsuba, rig: StereoRig, seed: int) -> TracedScene:
    """Trace a random scene.

    Parameters
    ----------
    mitsuba : Mitsuba
        The renderer, from `load_mitsuba`.
    rig : StereoRig
        Cameras and phantom.
    seed : int
        Seed of all random numbers.
    """
    look = draw_appearance("random", seed)
    rng = np.random.default_rng(seed)
    begin, step = float(rng.uniform(*_BEGIN)), float(rng.uniform(*_STEP))
    depth = begin + step * (_EXPOSURES - 1)
    images, shares, ends, widths = [], [], [], []
    pairs = trace_insertion(
        mitsuba, rig, look, frames=_EXPOSURES, depth=depth, step=step, begin=begin, empty_first=True
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
    """Return the image of the shaft of a needle.

    Parameters
    ----------
    line : ndarray, shape (n, 3)
        Axis of the shaft, towards the tip, in `rig` [m].
    diameter : float
        Diameter of the shaft [m].
    camera : SimulatedCamera
        The camera.

    Returns
    -------
    share : ndarray of uint8, shape (height, width)
        255 times the share of each pixel that belongs to the shaft, cut straight at its end.
    end : ndarray, shape (2,)
        End of the shaft [px]; NaN outside the image.
    width_px : float
        Median width of the shaft [px].
    """

    def seen(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(project(points, camera))

    middle = seen(line)
    along = np.gradient(middle, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    ahead = np.gradient(line, axis=0)
    # The outline of a round shaft is perpendicular to the line of sight.
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
