"""The rig at one moment, as a page shows it."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from needle_core.status_messages import ControllerStatus, DeviceStatus

Array: TypeAlias = NDArray[np.float64]
# Axes at rest are so near to where they were [m].
_AT_REST = 1e-4


@dataclasses.dataclass(frozen=True)
class SeenTip:
    """The last tip that the cameras, or what stands in for them, measured.

    Attributes
    ----------
    position : ndarray, shape (3,)
        In `rig` [m].
    covariance : ndarray, shape (3, 3)
        Of the position [m^2].
    age : float
        Since its message came [s].
    """

    position: Array
    covariance: Array
    age: float


@dataclasses.dataclass(frozen=True)
class CoursePoint:
    """One estimate of an insertion.

    Attributes
    ----------
    depth : float
        Insertion at that time [m].
    r1, sigma : float
        Signed distance of the tip from the target plane, and its standard deviation [m].
    position : ndarray, shape (3,)
        Of the tip in `rig` [m].
    covariance : ndarray, shape (3, 3)
        Of the position, in `rig` [m^2].
    """

    depth: float
    r1: float
    sigma: float
    position: Array
    covariance: Array


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """All that a page shows but the images.

    Attributes
    ----------
    device, controller : DeviceStatus, ControllerStatus, or None
        Their last words; None: not heard.
    insertion, rotation : float
        The joints [m], [rad]; NaN: not heard, or not for a second.
    tip : SeenTip or None
        The last measured tip.
    tip_lost_for : float
        How long the cameras have answered without a tip [s]; 0: the last answer had one.
    T_rig_plane : ndarray, shape (4, 4)
        The target plane's frame [m].
    course : tuple of CoursePoint
        Estimates since the start, deeper and deeper.
    troubles : tuple of str
        What nodes warn of in /diagnostics.
    answer : str
        What the last service call was answered.
    """

    device: DeviceStatus | None = None
    controller: ControllerStatus | None = None
    insertion: float = math.nan
    rotation: float = math.nan
    tip: SeenTip | None = None
    tip_lost_for: float = 0.0
    T_rig_plane: Array = dataclasses.field(default_factory=lambda: np.eye(4))
    course: tuple[CoursePoint, ...] = ()
    troubles: tuple[str, ...] = ()
    answer: str = ""

    @property
    def shaft(self) -> Array:
        """Points of the needle's way in `rig` from the entry to the tip, shape (n, 3) [m]."""
        end = self.insertion + _AT_REST
        within = [point for point in self.course if not point.depth > end]
        return np.array([np.zeros(3), *(point.position for point in within)])


def trouble_of(device: DeviceStatus) -> str:
    """Return the fault of a device, or why it last stopped, refused or waits; empty: neither."""
    return device.fault or device.reason
