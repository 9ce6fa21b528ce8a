"""The region of safe starts: how far a hand may misplace the needle and still reach the target.

As of M. Hoelscher et al. (T-RO 2025), for a needle that is steered after it: a start is safe from
where there is a path that is clear.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.entry import entry_state
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_planner import PathPlanner


@dataclasses.dataclass(frozen=True)
class SafeStarts:
    """Which starts are safe, of a grid of offsets and one of tilts.

    Attributes
    ----------
    offsets, angles : ndarray, shape (N,), (M,)
        Misplacements along each axis [m], [rad].
    shifted : ndarray of bool, shape (N, N)
        Of entries (offsets[i], offsets[j]) beside the entry in x and y.
    tilted : ndarray of bool, shape (M, M)
        Of headings with pitch angles[i] and yaw angles[j] at the entry.
    """

    offsets: Array
    angles: Array
    shifted: npt.NDArray[np.bool_]
    tilted: npt.NDArray[np.bool_]

    @property
    def largest_shift(self) -> float:
        """Distance within which every offset of the grid is safe [m]; 0 where none is."""
        return _largest(self.offsets, self.shifted)

    @property
    def largest_tilt(self) -> float:
        """Angle within which every tilt of the grid is safe [rad]; 0 where none is."""
        return _largest(self.angles, self.tilted)


def safe_starts(
    planner: PathPlanner,
    target: npt.ArrayLike,
    obstacles: Obstacles,
    curvature: float,
    *,
    offsets: npt.ArrayLike,
    angles: npt.ArrayLike,
) -> SafeStarts:
    """Return which starts are safe.

    Parameters
    ----------
    planner : PathPlanner
        Its settings say what must be clear.
    target : array_like, shape (3,)
        In `rig` [m].
    obstacles : Obstacles
        What the needle must not touch.
    curvature : float
        kappa [1/m].
    offsets : array_like, shape (N,)
        Misplacements along x, and along y [m].
    angles : array_like, shape (M,)
        Errors of pitch, and of yaw [rad].
    """
    places, tilts = np.asarray(offsets, dtype=float), np.asarray(angles, dtype=float)

    def is_safe(**start: float) -> bool:
        return planner.path(entry_state(curvature, **start), target, obstacles) is not None

    return SafeStarts(
        offsets=places,
        angles=tilts,
        shifted=np.array([[is_safe(x=x, y=y) for y in places] for x in places]),
        tilted=np.array([[is_safe(pitch=pitch, yaw=yaw) for yaw in tilts] for pitch in tilts]),
    )


def _largest(grid: Array, safe: npt.NDArray[np.bool_]) -> float:
    distance = np.hypot(grid[:, np.newaxis], grid[np.newaxis, :])
    nearest_unsafe = float(np.min(distance[~safe])) if not np.all(safe) else np.inf
    within = distance[(distance < nearest_unsafe) & (distance <= np.max(np.abs(grid)))]
    return float(np.max(within, initial=0.0))
