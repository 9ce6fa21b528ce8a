"""State of the rig at one moment, as shown on a page."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from needle_core.messages import Vector3
from needle_core.status_messages import ControllerStatus, DeviceStatus

Array: TypeAlias = NDArray[np.float64]
# Tolerance of the axes at rest [m].
_AT_REST = 1e-4


@dataclasses.dataclass(frozen=True)
class MeasuredTip:
    """The last measured tip.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Position in `rig` [m].
    covariance : ndarray, shape (3, 3)
        Covariance of the position [m^2].
    age : float
        Time since its message arrived [s].
    """

    position: Array
    covariance: Array
    age: float


@dataclasses.dataclass(frozen=True)
class TrackPoint:
    """One estimate during an insertion.

    Attributes
    ----------
    depth : float
        Insertion at the time of the estimate [m].
    r1, sigma : float
        Signed distance of the tip from the target plane, and its standard deviation [m].
    position : ndarray, shape (3,)
        Position of the tip in `rig` [m].
    covariance : ndarray, shape (3, 3)
        Covariance of the position, in `rig` [m^2].
    """

    depth: float
    r1: float
    sigma: float
    position: Array
    covariance: Array


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """State of the rig without the images.

    Attributes
    ----------
    device, controller : DeviceStatus, ControllerStatus, or None
        Last status of each; None if none was received.
    insertion, rotation : float
        Joint positions [m], [rad]; NaN if none was received within the last second.
    tip : MeasuredTip or None
        The last measured tip.
    tip_lost_for : float
        Time since the cameras lost the tip [s]; 0 if they have not lost it.
    T_rig_plane : ndarray, shape (4, 4)
        Frame of the target plane [m].
    track : tuple of TrackPoint
        Estimates since the start, by increasing depth.
    warnings : tuple of str
        Current warnings from /diagnostics.
    answer : str
        Answer of the last service call.
    proposed_point : tuple of float, or None
        Target point that a planner proposes, in `rig` [m].
    """

    device: DeviceStatus | None = None
    controller: ControllerStatus | None = None
    insertion: float = math.nan
    rotation: float = math.nan
    tip: MeasuredTip | None = None
    tip_lost_for: float = 0.0
    T_rig_plane: Array = dataclasses.field(default_factory=lambda: np.eye(4))
    track: tuple[TrackPoint, ...] = ()
    warnings: tuple[str, ...] = ()
    answer: str = ""
    proposed_point: Vector3 | None = None

    @property
    def shaft(self) -> Array:
        """Points of the shaft in `rig` from the entry to the tip, shape (n, 3) [m]."""
        end = self.insertion + _AT_REST
        within = [point for point in self.track if not point.depth > end]
        return np.array([np.zeros(3), *(point.position for point in within)])


def stop_reason(device: DeviceStatus) -> str:
    """Return a device's fault, or the reason for its last stop, refusal or wait; empty if none."""
    return device.fault or device.reason
