"""Triangle mesh of the needle: a tube along a bent centreline, with a bevel at its end."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_sim.needle.se3 import FloatArray
from needle_sim.path_traced.appearance import Appearance

IndexArray = NDArray[np.uint32]

# Sides of the tube's section: with 40, it is at most 0.3 % thinner than a round one.
_SIDES = 40
# Constant number of sections along the tube, so that one mesh serves a whole sequence.
_STATIONS = 480
_BORE_SHARE = 0.6
_BORE_DEPTH_DIAMETERS = 4.0


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh.

    Attributes
    ----------
    points, normals : ndarray, shape (N, 3)
        Vertices in `rig` [m], and the surface normals there.
    texture : ndarray, shape (N, 2)
        Texture coordinates; the first grows along the axis.
    faces : ndarray of uint32, shape (F, 3)
        Vertex indices of each triangle.
    """

    points: FloatArray
    normals: FloatArray
    texture: FloatArray
    faces: IndexArray


@dataclasses.dataclass(frozen=True, eq=False)
class NeedleMesh:
    """Meshes of a needle's parts, and its characteristic points.

    Attributes
    ----------
    line : ndarray, shape (M, 3)
        Centreline in `rig`, the end of the axis last [m].
    parts : dict of str to Mesh
        `shaft`, the outside of the tube; `face`, the bevel; for a hollow needle `bore`, its inside.
    extreme : ndarray, shape (3,)
        Foremost point of the metal, half a diameter off the end of the axis, in `rig` [m].
    face_middle : ndarray, shape (3,)
        Intersection of the axis with the plane of the bevel, in `rig` [m].
    """

    line: FloatArray
    parts: dict[str, Mesh]
    extreme: FloatArray
    face_middle: FloatArray


class _Axis:
    """Centreline by arc length, with lateral directions."""

    def __init__(self, line: FloatArray, sharp_side: FloatArray) -> None:
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        self._distance = np.concatenate([[0.0], np.cumsum(steps)])
        self._line = line
        self._tangent = np.gradient(line, self._distance, axis=0)
        self._sharp_side = sharp_side
        self.length = float(self._distance[-1])

    def at(self, distance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points and two lateral directions, each (..., 3); the first to the sharp side."""
        point, tangent = (
            np.stack(
                [np.interp(distance, self._distance, part[:, axis]) for axis in range(3)], axis=-1
            )
            for part in (self._line, self._tangent)
        )
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        side = self._sharp_side - (tangent @ self._sharp_side)[..., np.newaxis] * tangent
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        return point, side, np.cross(tangent, side)


def needle_mesh(line: FloatArray, sharp_side: FloatArray, needle: Appearance) -> NeedleMesh:
    """Return the mesh of the needle along a centreline.

    The last point of the line is the end of the axis, level with the foremost point of the metal.
    The plane of the bevel contains the foremost point and meets the axis half the bevel's length
    behind its end.

    Parameters
    ----------
    line : ndarray, shape (M, 3)
        Centreline in `rig`, the end last [m].
    sharp_side : ndarray, shape (3,)
        Direction from the axis to the foremost point, in `rig`.
    needle : Appearance
        Diameter and bevel of the needle, and whether it is hollow.
    """
    axis = _Axis(line, sharp_side)
    radius = needle.diameter / 2.0
    # Denser at the bent and bevelled end.
    station = axis.length * (1.0 - (1.0 - np.linspace(0.0, 1.0, _STATIONS)) ** 1.5)
    angle = np.linspace(0.0, 2.0 * np.pi, _SIDES, endpoint=False)
    # Arc length at which the bevel cuts the tube at each angle; stations beyond it coincide.
    cut = axis.length - needle.bevel_length / 2.0 * (1.0 - np.cos(angle))
    reach = np.minimum(station[:, np.newaxis], cut)
    middle, side, third = axis.at(reach)
    outward = np.cos(angle)[:, np.newaxis] * side + np.sin(angle)[:, np.newaxis] * third
    shaft = _tube(middle + radius * outward, outward)

    rim = shaft.points[-_SIDES:]
    extreme, heel = rim[0], rim[_SIDES // 2]
    face_middle = axis.at(np.array(axis.length - needle.bevel_length / 2.0))[0]
    normal = np.cross(extreme - heel, rim[_SIDES // 4] - rim[3 * _SIDES // 4])
    normal *= np.sign(normal @ (line[-1] - line[-2])) / np.linalg.norm(normal)
    parts = {"shaft": shaft}
    if needle.hollow:
        inner = face_middle + _BORE_SHARE * (rim - face_middle)
        parts["face"] = _ring_face(rim, inner, normal)
        parts["bore"] = _bore(axis, inner, radius * _BORE_SHARE, angle, needle)
    else:
        parts["face"] = _ring_face(rim, np.broadcast_to(face_middle, rim.shape), normal)
    return NeedleMesh(line, parts, extreme, face_middle)


def _tube(points: FloatArray, normals: FloatArray) -> Mesh:
    """Return the triangles between rings of vertices, (R, S, 3)."""
    rings, sides = points.shape[:2]
    ring, place = np.mgrid[: rings - 1, :sides]
    here, beside = ring * sides + place, ring * sides + (place + 1) % sides
    faces = np.stack([here, beside, beside + sides, here, beside + sides, here + sides], axis=-1)
    texture = np.stack(np.mgrid[:rings, :sides] / np.array([[[rings]], [[sides]]]), axis=-1)
    return Mesh(
        points.reshape(-1, 3),
        normals.reshape(-1, 3),
        texture.reshape(-1, 2),
        faces.reshape(-1, 3).astype(np.uint32),
    )


def _ring_face(outer: FloatArray, inner: FloatArray, normal: FloatArray) -> Mesh:
    """Return the flat ring between two closed lines of vertices, (S, 3)."""
    both = np.stack([outer, inner])
    return _tube(both, np.broadcast_to(normal, both.shape))


def _bore(
    axis: _Axis, opening: FloatArray, radius: float, angle: FloatArray, needle: Appearance
) -> Mesh:
    """Return the bore of a hollow needle's end, closed at its bottom."""
    bottom = np.array(axis.length - needle.bevel_length - _BORE_DEPTH_DIAMETERS * needle.diameter)
    middle, side, third = axis.at(bottom)
    outward = np.cos(angle)[:, np.newaxis] * side + np.sin(angle)[:, np.newaxis] * third
    deep = middle + radius * outward
    points = np.stack([opening, deep, np.broadcast_to(middle, deep.shape)])
    return _tube(points, np.broadcast_to(-outward, points.shape))
