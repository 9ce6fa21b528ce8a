"""Window of a camera: a flat face, the layers behind it, and the body."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Layer:
    """A plane-parallel plate, such as a wall of acrylic.

    Attributes
    ----------
    thickness : float
        Along the normal of the window [m].
    refractive_index : float
        Relative to air [-], at least 1.
    """

    thickness: float
    refractive_index: float


@dataclasses.dataclass(frozen=True)
class Window:
    """Surface at which light enters the body with the needle.

    Attributes
    ----------
    point : ndarray, shape (3,)
        Any point of the outer face in `rig` [m].
    normal : ndarray, shape (3,)
        Unit vector in `rig`, across the faces and towards the camera.
    layers : tuple of Layer
        From the outer face inwards; none for a body with a free surface.
    inside : float
        Refractive index of the body relative to air [-], at least 1.
    """

    point: Array
    normal: Array
    layers: tuple[Layer, ...]
    inside: float

    @property
    def thickness(self) -> float:
        """Thickness of all layers together [m]."""
        return sum(layer.thickness for layer in self.layers)

    def height(self, points: Array) -> Array:
        """Return the height of points above the outer face, towards the camera.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            In `rig` [m].

        Returns
        -------
        ndarray, shape (...)
            Negative behind the face [m].
        """
        return np.asarray((points - self.point) @ self.normal)

    def depth(self, points: Array) -> Array:
        """Return the depth of points in the body, behind all layers.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            In `rig` [m].

        Returns
        -------
        ndarray, shape (...)
            Negative in a layer and before the window [m].
        """
        return -self.height(points) - self.thickness


def common_surface(left: Window, right: Window) -> Window | None:
    """Return the level, free surface that two windows share, if any."""
    for window in (left, right):
        if window.layers or not np.array_equal(window.normal, [1.0, 0.0, 0.0]):
            return None
    same = left.point[0] == right.point[0] and left.inside == right.inside
    return left if same else None


def surface_from_above(surface_height: float, refractive_index: float) -> Window:
    """Return the free, level surface of a body.

    Parameters
    ----------
    surface_height : float
        x of the surface in `rig` [m].
    refractive_index : float
        Refractive index of the body relative to air [-].
    """
    return Window(
        np.array([surface_height, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), (), refractive_index
    )
