"""The block that both cameras look into, and the planes that they see behind it."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_sim.camera.optics import FloatImage
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig
from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.appearance import Appearance
from needle_sim.path_traced.floors import FloorPicture

LENGTH = 0.155
"""Of the block along z, from the needle's entry on [m]."""
_SIDE = 0.07  # of a block under one level surface [m]


def refractive_index(rig: StereoRig) -> float:
    """Return the phantom's refractive index [-]."""
    return rig.left.window.indices[-1]


def is_box(rig: StereoRig) -> bool:
    """Return whether each camera has a wall of its own, all clear; else both share one surface."""
    return float(rig.left.window.normal @ rig.right.window.normal) < 0.5


def reach_sideways(camera: SimulatedCamera, rig: StereoRig) -> float:
    """Return how far a camera's wall reaches to both sides; a shared surface is endless [m]."""
    other = rig.right if camera is rig.left else rig.left
    return other.window.inner if is_box(rig) else np.inf


def sides(rig: StereoRig, look: Appearance) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the block's bounds in x and y [m]."""
    if is_box(rig):
        return (-rig.half_height, rig.half_height), (-rig.half_width, rig.half_width)
    return (look.floor_height, rig.half_height), (-_SIDE, _SIDE)


@dataclasses.dataclass(frozen=True, eq=False)
class Backdrop:
    """A plane with a picture behind the needle, upright before a camera's window.

    What stands in the air behind a clear box is put where it would be if the gel went on.

    Attributes
    ----------
    normal, sideways : ndarray, shape (3,)
        Unit vectors in `rig`, towards the camera and across the needle; both across z.
    depth : float
        Of the plane behind the needle's axis [m].
    gel : float
        Way through the phantom towards it, from the window's inner face [m].
    picture : FloorPicture
        How much light each place gives back.
    """

    normal: FloatArray
    sideways: FloatArray
    depth: float
    gel: float
    picture: FloorPicture

    def points(self, aside: FloatArray, along: FloatArray) -> FloatArray:
        """Return places on the plane, (..., 3) in `rig`, by y-like and z coordinate [m]."""
        return np.asarray(
            np.asarray(aside)[..., np.newaxis] * self.sideways
            + np.asarray(along)[..., np.newaxis] * [0.0, 0.0, 1.0]
            - self.depth * self.normal
        )

    def met_by(self, origin: FloatArray, direction: FloatArray) -> FloatArray:
        """Return where rays, each (..., 3), meet the plane, (..., 3) in `rig` [m]."""
        length = -(self.depth + origin @ self.normal) / (direction @ self.normal)
        return np.asarray(origin + length[..., np.newaxis] * direction)

    def reflectance(self, points: FloatArray) -> FloatImage:
        """Return the picture at places of the plane, (rows, columns, 3) in `rig` [m]."""
        return self.picture.at(points @ self.sideways, points[..., 2])


def backdrop(
    camera: SimulatedCamera, rig: StereoRig, look: Appearance, picture: FloorPicture
) -> Backdrop:
    """Return what a camera sees behind the needle: the floor, or what stands behind the box."""
    window = camera.window
    normal = np.array([*window.normal[:2], 0.0])
    depth = window.inner + look.behind if is_box(rig) else -look.floor_height
    gel = 2.0 * window.inner if is_box(rig) else window.inner + depth
    return Backdrop(normal / np.linalg.norm(normal), window.sideways, depth, gel, picture)
