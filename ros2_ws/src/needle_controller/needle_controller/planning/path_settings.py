"""Settings of the planner, and what it is asked."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from needle_controller.model.arrays import Array
from needle_core.settings.bounds import Bounds


# Read by compiled code.
class PathSettings(NamedTuple):
    """Settings with which a path is planned.

    Attributes
    ----------
    max_rotation_per_length : float
        Most that the bevel turns per inserted length [rad/m].
    curvature_share : float
        Share of the curvature that paths are planned with: the rest corrects.
    comfortable_share : float
        Share of the curvature with which the last leg had better lead to the target.
    needle_radius : float
        Of the needle [m].
    sigmas : float
        So many standard deviations of what is unknown must be clear, beside the needle's radius.
    settled_std : float
        By how much a needle strays from the path that it follows [m].
    correction_length : float
        Insertion after which what is not known now has been seen and steered back [m].
    committed_length : float
        Insertion for which a path must be clear by what is known now: what is farther is planned
        anew, from what is seen on the way, before the needle is there [m].
    comfort : float
        What a path had better be clear by beyond what it must be [m].
    goal_tolerance : float
        Distance from the target by which a path may pass it [m].
    longest : float
        Of a path from the entry on [m].
    """

    max_rotation_per_length: Annotated[float, Bounds(1.0, 1e5, "rad/m")]
    curvature_share: Annotated[float, Bounds(0.5, 1.0, "-")] = 0.9
    comfortable_share: Annotated[float, Bounds(0.5, 1.0, "-")] = 0.8
    needle_radius: Annotated[float, Bounds(0.0, 0.01, "m")] = 0.00035
    sigmas: Annotated[float, Bounds(0.0, 10.0, "-")] = 2.0
    settled_std: Annotated[float, Bounds(0.0, 0.01, "m")] = 0.0002
    correction_length: Annotated[float, Bounds(1e-3, 0.2, "m")] = 0.03
    committed_length: Annotated[float, Bounds(1e-3, 0.2, "m")] = 0.01
    comfort: Annotated[float, Bounds(0.0, 0.02, "m")] = 0.0015
    goal_tolerance: Annotated[float, Bounds(0.0, 0.01, "m")] = 0.001
    longest: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.2

    @property
    def least_clear(self) -> float:
        """Least clearance of a path's axis where the pose is known [m]."""
        return self.needle_radius + self.sigmas * self.settled_std


class Unknown(NamedTuple):
    """Uncertainty of the tip's pose where a path begins.

    Attributes
    ----------
    position_std : float
        Of the tip, across the needle [m].
    heading_std : float
        Of its heading [rad].
    """

    position_std: float
    heading_std: float


class Question(NamedTuple):
    """Task of a path.

    Attributes
    ----------
    start : ndarray, shape (3, 4)
        The tip's pose.
    target : ndarray, shape (3,)
        Where to [m].
    curvature : float
        That is planned with, `curvature_share` of kappa [1/m].
    table : ndarray, shape (N, 7)
        See `Obstacles`.
    unknown : Unknown
        How well the pose is known.
    reach : float
        Longest that the path may be [m].
    settings : PathSettings
        What must be clear.
    """

    start: Array
    target: Array
    curvature: float
    table: Array
    unknown: Unknown
    reach: float
    settings: PathSettings
