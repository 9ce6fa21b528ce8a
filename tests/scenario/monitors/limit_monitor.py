"""Limits of a rig, judged from outside: set-points as they are sent, and the motors' ways."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping

from needle_device_driver.supervisor.limits import SafetyLimits

# From one set-point to the next [s].
_SET_POINT_PERIOD = 0.02
# A drive may be behind by its following error, which is judged by a position of a cycle ago, one
# cycle later, and by what was on its way meanwhile: so many set-points more.
_SET_POINTS_BEHIND = 3
# What drives of such a rig swing over beyond its limits [m], [rad].
_PLACE_ROOM, _TURN_ROOM = 0.0011, 0.3
# Function codes of the process data that carry controlword and mode, and the target (CiA 402).
_CONTROL, _TARGET = 0x200, 0x300
# Bits of the controlword that let a drive operate, and cyclic synchronous position mode.
_OPERATE, _CYCLIC_POSITION = 0x0F, 8


class SetPointFrames:
    """Reads frames.

    Parameters
    ----------
    counts_per_unit : mapping of int to float
        Of the drives, by their node ids [1/m] or [1/rad].
    """

    def __init__(self, counts_per_unit: Mapping[int, float]) -> None:
        self._counts_per_unit = counts_per_unit
        self._operates = dict.fromkeys(counts_per_unit, False)

    def take(self, identifier: int, data: bytes) -> tuple[int, float | None] | None:
        """Return a drive's node id and where it shall go.

        Parameters
        ----------
        identifier : int
            Of a frame.
        data : bytes
            Its own.

        Returns
        -------
        tuple of int and (float or None), or None
            [m] or [rad]; None in its place if the drive shall not go there. None for other frames.
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
    """Judges a way by the time that it took, over all spans of it at once.

    Parameters
    ----------
    speed : float
        At which it may go on, in its unit a second.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self.forget()

    def forget(self) -> None:
        """Begin anew at the next place."""
        self._least = {1.0: math.inf, -1.0: math.inf}

    def ahead(self, at: float, place: float) -> float:
        """Return by how much the way to a place is longer than `speed` allows.

        That is the most over all spans that end now: in each, the way less what its time allows.

        Parameters
        ----------
        at : float
            When it is there [s].
        place : float
            In any unit.
        """
        most = 0.0
        for sign, least in self._least.items():
            beyond = sign * place - self._speed * at
            self._least[sign] = min(least, beyond)
            most = max(most, beyond - self._least[sign])
        return most


@dataclasses.dataclass(frozen=True)
class _Axis:
    """One axis; `scale` is units for people in one of SI, `behind` the most that it may be [SI]."""

    name: str
    unit: str
    scale: float
    speed: float
    behind: float
    set_points: SpeedBudget
    motor: SpeedBudget

    def said(self, way: float, most: float) -> str:
        """Return a way beside its bound."""
        return f"{way * self.scale:.4g} {self.unit} (at most {most * self.scale:.4g})"


class LimitMonitor:
    """Says what is beyond the limits.

    Parameters
    ----------
    bounds : SafetyLimits
        Of the rig.
    late : float
        How late a set-point may be sent: the next one may then follow it so much sooner [s].
    """

    def __init__(self, bounds: SafetyLimits, late: float = 0.0) -> None:
        self._bounds = bounds
        # One may be early by all of its period.
        self._early = _SET_POINT_PERIOD + late

        def axis(name: str, unit: str, scale: float, speed: float, behind: float) -> _Axis:
            behind += _SET_POINTS_BEHIND * _SET_POINT_PERIOD * speed
            return _Axis(name, unit, scale, speed, behind, SpeedBudget(speed), SpeedBudget(speed))

        self._axes = (
            axis("insertion", "mm", 1e3, bounds.max_speed, bounds.insertion_following_error),
            axis("rotation", "rad", 1.0, bounds.max_rotation_rate, bounds.rotation_following_error),
        )

    def observe_set_point(self, at: float, axis: int, place: float | None) -> Iterator[str]:
        """Take what is sent to a drive, whatever a bus makes of it.

        Parameters
        ----------
        at : float
            When [s].
        axis : int
            0 is insertion, 1 rotation.
        place : float or None
            Where to [m], [rad]; None if the drive is told not to go there.

        Yields
        ------
        str
            What is beyond the limits.
        """
        its = self._axes[axis]
        if place is None:
            its.set_points.forget()
            return
        ahead, bound = its.set_points.ahead(at, place), its.speed * self._early
        if ahead > bound:
            yield f"set-points of {its.name} {its.said(ahead, bound)} ahead of its speed limit"

    def observe_motors(self, at: float, insertion: float, rotation: float) -> Iterator[str]:
        """Take where the motors really are; yields what is beyond the limits.

        Parameters
        ----------
        at : float
            When [s].
        insertion, rotation : float
            [m], [rad].
        """
        deepest = self._bounds.max_depth + _PLACE_ROOM
        if insertion > deepest:
            yield f"insertion is {insertion * 1e3:.4g} mm, at most {deepest * 1e3:.4g}"
        farthest = self._bounds.max_rotation + _TURN_ROOM
        if abs(rotation) > farthest:
            yield f"rotation is {rotation:.4g} rad, at most {farthest:.4g} either way"
        for its, place in zip(self._axes, (insertion, rotation), strict=True):
            # Who is behind goes on as fast as it can (docs/safety.md, following_error).
            ahead = its.motor.ahead(at, place)
            if ahead > its.behind:
                yield f"{its.name} went {its.said(ahead, its.behind)} farther than its speed allows"
