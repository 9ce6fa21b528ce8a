"""Limits of a rig, checked on the transmitted set-points and the motion of the motors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping

from needle_device_driver.supervisor.limits import SafetyLimits

# Period of the set-points [s].
_SET_POINT_PERIOD = 0.02
# A drive lags by its following error and by these set-points: the error is computed from a position
# of the previous cycle, one cycle later, and one more set-point may be in transit.
_SET_POINTS_BEHIND = 3
# Overshoot of the drives beyond the limits [m], [rad].
_DEPTH_MARGIN, _ROTATION_MARGIN = 0.0011, 0.3
# Function codes of the process data that carry controlword and mode, and the target (CiA 402).
_CONTROL, _TARGET = 0x200, 0x300
# Bits of the controlword that enable operation, and cyclic synchronous position mode.
_OPERATE, _CYCLIC_POSITION = 0x0F, 8


class SetPointFrames:
    """Decodes the set-points from the frames that are sent to the drives.

    Parameters
    ----------
    counts_per_unit : mapping of int to float
        Counts per unit of the drives, by their node ids [1/m] or [1/rad].
    """

    def __init__(self, counts_per_unit: Mapping[int, float]) -> None:
        self._counts_per_unit = counts_per_unit
        self._operates = dict.fromkeys(counts_per_unit, False)

    def decode_set_point(self, identifier: int, data: bytes) -> tuple[int, float | None] | None:
        """Return the node id and the set-point of a drive.

        Parameters
        ----------
        identifier : int
            COB-ID of a frame.
        data : bytes
            Data of the frame.

        Returns
        -------
        tuple of int and (float or None), or None
            Set-point [m] or [rad], None if the drive is not enabled for it. None for other frames.
        """
        node, function = identifier & 0x7F, identifier & ~0x7F
        if node not in self._operates or function not in (_CONTROL, _TARGET):
            return None
        if function == _CONTROL:
            self._operates[node] = data[0] & _OPERATE == _OPERATE and data[2] == _CYCLIC_POSITION
        if not self._operates[node]:
            return node, None
        if function == _CONTROL:
            return None
        counts = int.from_bytes(data[:4], "little", signed=True)
        return node, counts / self._counts_per_unit[node]


class SpeedBudget:
    """Checks a motion against a speed limit, over all its time spans at once.

    Parameters
    ----------
    speed : float
        Speed limit, in its unit per second.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self.reset()

    def reset(self) -> None:
        """Reset; the next position is the first one."""
        self._least = {1.0: math.inf, -1.0: math.inf}

    def ahead(self, at: float, position: float) -> float:
        """Return by how much the motion to a position exceeds what `speed` allows.

        This is the maximum over all spans that end now of the distance less speed x duration.

        Parameters
        ----------
        at : float
            Time [s].
        position : float
            Position in any unit.
        """
        most = 0.0
        for sign, least in self._least.items():
            beyond = sign * position - self._speed * at
            self._least[sign] = min(least, beyond)
            most = max(most, beyond - self._least[sign])
        return most


@dataclasses.dataclass(frozen=True)
class _Axis:
    """One axis; `scale` converts from SI to `unit`, `lag` is its largest lag [SI]."""

    name: str
    unit: str
    scale: float
    speed: float
    lag: float
    set_points: SpeedBudget
    motor: SpeedBudget

    def text(self, distance: float, most: float) -> str:
        """Return a distance and its bound as text."""
        return f"{distance * self.scale:.4g} {self.unit} (at most {most * self.scale:.4g})"


class LimitMonitor:
    """Reports set-points and motions beyond the limits.

    Parameters
    ----------
    bounds : SafetyLimits
        Limits of the rig.
    late : float
        Lateness of a set-point, by which the next interval may be shorter [s].
    """

    def __init__(self, bounds: SafetyLimits, late: float = 0.0) -> None:
        self._bounds = bounds
        # A set-point may be early by its whole period.
        self._early = _SET_POINT_PERIOD + late

        def axis(name: str, unit: str, scale: float, speed: float, lag: float) -> _Axis:
            lag += _SET_POINTS_BEHIND * _SET_POINT_PERIOD * speed
            return _Axis(name, unit, scale, speed, lag, SpeedBudget(speed), SpeedBudget(speed))

        self._axes = (
            axis("insertion", "mm", 1e3, bounds.max_speed, bounds.insertion_following_error),
            axis("rotation", "rad", 1.0, bounds.max_rotation_rate, bounds.rotation_following_error),
        )

    def observe_set_point(self, at: float, axis: int, position: float | None) -> Iterator[str]:
        """Observe a set-point that is sent to a drive.

        Parameters
        ----------
        at : float
            Time [s].
        axis : int
            0 is insertion, 1 rotation.
        position : float or None
            Set-point [m], [rad]; None if the drive is not enabled.

        Yields
        ------
        str
            Violation of a limit.
        """
        its = self._axes[axis]
        if position is None:
            its.set_points.reset()
            return
        ahead, bound = its.set_points.ahead(at, position), its.speed * self._early
        if ahead > bound:
            yield f"set-points of {its.name} {its.text(ahead, bound)} ahead of its speed limit"

    def observe_motors(self, at: float, insertion: float, rotation: float) -> Iterator[str]:
        """Observe the true position of the motors; yields violations of the limits.

        Parameters
        ----------
        at : float
            Time [s].
        insertion, rotation : float
            [m], [rad].
        """
        deepest = self._bounds.max_depth + _DEPTH_MARGIN
        if insertion > deepest:
            yield f"insertion is {insertion * 1e3:.4g} mm, at most {deepest * 1e3:.4g}"
        farthest = self._bounds.max_rotation + _ROTATION_MARGIN
        if abs(rotation) > farthest:
            yield f"rotation is {rotation:.4g} rad, at most {farthest:.4g} either way"
        for its, position in zip(self._axes, (insertion, rotation), strict=True):
            # A lagging drive catches up at its full speed (docs/safety.md, following_error).
            ahead = its.motor.ahead(at, position)
            if ahead > its.lag:
                yield f"{its.name} went {its.text(ahead, its.lag)} farther than its speed allows"
