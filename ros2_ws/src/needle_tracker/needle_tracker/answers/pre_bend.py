"""From the direction of the visible end to the heading, where the needle's roll is known.

A pre-bent needle (10 deg over the last 9 mm) leans off its heading, towards -y of its own frame:
the visible end points along d = cos(lean) z - sin(lean) y. Images do not show the roll, so that y
has to come from elsewhere: from the controller's estimate.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ITERATIONS = 20


def heading_of(
    direction: Array,
    direction_covariance: Array,
    rotation: Array,
    roll_sigma: float,
    lean: float,
) -> tuple[Array, Array]:
    """Return the heading behind the direction of the visible end.

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Unit vector along the visible end, towards the tip, in `rig`.
    direction_covariance : ndarray, shape (3, 3)
        Of the direction [-].
    rotation : ndarray, shape (3, 3)
        Estimated axes of the tip's frame in `rig`, as columns; only their roll about the heading
        counts.
    roll_sigma : float
        Standard deviation of that roll [rad].
    lean : float
        Angle between heading and visible end [rad].

    Returns
    -------
    heading : ndarray, shape (3,)
        Unit vector in `rig`.
    covariance : ndarray, shape (3, 3)
        Of the heading [-]: the direction's, and what the roll leaves open.
    """
    heading = np.array(direction, dtype=np.float64)
    aside = np.zeros(3)
    for _ in range(_ITERATIONS):
        # The estimated frame, turned the shortest way onto the heading: its roll is kept.
        aside = _turned(rotation[:, 1], rotation[:, 2], heading)
        heading = math.cos(lean) * direction + math.sin(lean) * _across(aside, direction)
        heading /= np.linalg.norm(heading)
    sideways = np.cross(aside, heading)
    doubt = (math.sin(lean) * min(roll_sigma, math.pi)) ** 2
    return heading, direction_covariance + doubt * np.outer(sideways, sideways)


def _turned(vector: Array, start: Array, end: Array) -> Array:
    """Return a vector turned by the shortest rotation that takes one unit vector to another."""
    axis = np.cross(start, end)
    cosine = float(start @ end)
    return np.asarray(
        vector + np.cross(axis, vector) + np.cross(axis, np.cross(axis, vector)) / (1.0 + cosine)
    )


def _across(vector: Array, direction: Array) -> Array:
    """Return the unit vector across a direction that is nearest to a vector."""
    rest = vector - direction * float(direction @ vector)
    return np.asarray(rest / np.linalg.norm(rest))
