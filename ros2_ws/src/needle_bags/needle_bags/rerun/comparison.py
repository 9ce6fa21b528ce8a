"""Comparison of recorded and recomputed messages, field by field.

On one machine with one set of libraries, the same input gives bit-identical results. Another
processor or version of numpy, OpenCV or LLVM rounds the last digits differently, and a filter
propagates these differences over 120 steps. Each tolerance is far above rounding errors (about
1e-12 relative) and far below the accuracy of the quantity.
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_bags.reading.frames import INDEX
from needle_core.messages import INSERTION_JOINT, ROTATION_JOINT

Floats = npt.NDArray[np.float64]
Values = Mapping[str, Any]

ORIENTATION = "orientation"


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Allowed difference between two values of one kind: `absolute + relative * |recorded|`."""

    unit: str
    absolute: float
    relative: float
    reason: str


LENGTH = Tolerance("m", 1e-7, 1e-6, "less than a hundredth of a tip's error")
ANGLE = Tolerance("rad", 1e-6, 1e-6, "a hundredth of an encoder count of the rotation")
QUATERNION = Tolerance("-", 1e-6, 0.0, "half an angle")
RATIO = Tolerance("-", 1e-6, 1e-6, "sines of angles")
CURVATURE = Tolerance("1/m", 1e-5, 1e-6, "changes a heading by 1e-6 rad in 120 mm")
ROTATION_RATE = Tolerance("rad/m", 1e-3, 1e-6, "1e-6 rad in a step of 1 mm")
VIRTUAL_INPUT = Tolerance("1/m^2", 1e-3, 1e-5, "follows from the rotation per length")
DURATION = Tolerance("s", 1e-9, 1e-6, "resolution of the message: a nanosecond")
COVARIANCE = Tolerance("of sigmas", 0.0, 1e-3, "no variance is known to a thousandth")


@dataclasses.dataclass(frozen=True)
class Field:
    """Part of a message that is compared as a unit.

    Attributes
    ----------
    name : str
        Name in the report.
    paths : tuple of str
        Paths of its members in the message, such as `vector.x`.
    tolerance : Tolerance
        Allowed difference.
    """

    name: str
    paths: tuple[str, ...]
    tolerance: Tolerance


def _members(path: str, members: Iterable[str] = "xyz") -> tuple[str, ...]:
    return tuple(f"{path}.{member}" for member in members)


def _points(member: str) -> tuple[str, ...]:
    # A step has one point, a path of a continuous insertion two or three.
    return tuple(f"points.{k}.{member}" for k in range(3))


_POSE = (
    Field("position", _members("pose.pose.position"), LENGTH),
    Field(ORIENTATION, _members("pose.pose.orientation", "xyzw"), QUATERNION),
    Field("covariance", _members("pose.covariance", map(str, range(36))), COVARIANCE),
)

_PATH_POINTS = tuple(path for k in range(300) for path in _members(f"poses.{k}.pose.position"))

FIELDS: Mapping[str, tuple[Field, ...]] = {
    "needle/tip": (Field("point", _members("point"), LENGTH),),
    "needle/tip_pose": _POSE,
    "needle/estimate": _POSE,
    "needle/reduced_state": (
        Field("r1", ("vector.x",), LENGTH),
        Field("r2", ("vector.y",), ANGLE),
        Field("r3", ("vector.z",), ANGLE),
    ),
    "needle/linearized_state": (
        Field("s1", ("vector.x",), LENGTH),
        Field("s2", ("vector.y",), RATIO),
        Field("s3", ("vector.z",), CURVATURE),
    ),
    "needle/control_input": (
        Field("v", ("vector.x",), VIRTUAL_INPUT),
        Field("u", ("vector.y",), ROTATION_RATE),
        Field("rotation", ("vector.z",), ANGLE),
    ),
    "needle/planned_path": (Field("points", _PATH_POINTS, LENGTH),),
    "device/joint_trajectory": (
        Field("insertion", _points(f"positions.{INSERTION_JOINT}"), LENGTH),
        Field("rotation", _points(f"positions.{ROTATION_JOINT}"), ANGLE),
        Field("duration", _points("time_from_start"), DURATION),
    ),
}
"""Fields with a tolerance, by relative topic; all other members must be equal."""


@dataclasses.dataclass(frozen=True)
class Record:
    """Message as relative topic, stamp [ns] and members by path."""

    topic: str
    stamp: int
    values: Values


@dataclasses.dataclass(frozen=True)
class FieldResult:
    """Comparison of one field of one topic.

    Attributes
    ----------
    topic, field, unit : str
        Topic, field and unit.
    compared, differing : int
        Number of common messages, and of those that differ by more than the tolerance.
    largest : float
        Largest difference, in `unit`; infinite if strings differ or only one value is a number.
    first : int or None
        Stamp of the first differing message [ns].
    """

    topic: str
    field: str
    unit: str
    compared: int
    differing: int
    largest: float
    first: int | None


@dataclasses.dataclass(frozen=True)
class TopicResult:
    """Number of recorded messages of a topic, and stamps [ns] that only one side has."""

    topic: str
    recorded: int
    missing: tuple[int, ...]
    extra: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Result of comparing two bags."""

    topics: tuple[TopicResult, ...]
    fields: tuple[FieldResult, ...]

    @property
    def changed(self) -> bool:
        """Whether anything differs."""
        return any(t.missing or t.extra for t in self.topics) or any(
            field.differing for field in self.fields
        )


def compare(recorded: Iterable[Record], today: Iterable[Record]) -> Comparison:
    """Compare two sets of messages, matched by topic and stamp.

    Parameters
    ----------
    recorded, today : iterable of Record
        Both sides; messages with equal topic and stamp are matched in order.

    Returns
    -------
    Comparison
        Results for topics and fields, in the order of `FIELDS`.
    """
    before, now = _by_topic(recorded), _by_topic(today)
    topics: list[TopicResult] = []
    fields: list[FieldResult] = []
    order = [*FIELDS, *sorted((before.keys() | now.keys()) - FIELDS.keys())]
    for topic in order:
        old, new = before.get(topic, {}), now.get(topic, {})
        if not old and not new:
            continue
        both = [key for key in old if key in new]
        topics.append(
            TopicResult(
                topic,
                len(old),
                tuple(stamp for stamp, n in old if (stamp, n) not in new),
                tuple(stamp for stamp, n in new if (stamp, n) not in old),
            )
        )
        pairs = [(key[0], old[key], new[key]) for key in both]
        known = FIELDS.get(topic, ())
        fields += [_compare_field(topic, field, pairs) for field in known]
        fields.append(_compare_rest(topic, known, pairs))
    return Comparison(tuple(topics), tuple(fields))


_Pairs = Sequence[tuple[int, Values, Values]]


def _by_topic(records: Iterable[Record]) -> dict[str, dict[tuple[int, int], Values]]:
    found: dict[str, dict[tuple[int, int], Values]] = defaultdict(dict)
    for record in records:
        messages = found[record.topic]
        number = 0
        while (record.stamp, number) in messages:
            number += 1
        messages[record.stamp, number] = record.values
    return found


def _compare_field(topic: str, field: Field, pairs: _Pairs) -> FieldResult:
    tolerance = field.tolerance
    differing, largest, first = 0, 0.0, None
    for stamp, old, new in pairs:
        a, b = _numbers(field, old), _numbers(field, new)
        if a.shape != b.shape:
            difference, allowed = np.array([math.inf]), np.zeros(1)
        elif tolerance is COVARIANCE:
            difference, allowed = _relative_to_sigmas(a, b), np.full(a.shape, tolerance.relative)
        else:
            if field.name == ORIENTATION and float(a @ b) < 0.0:
                b = -b  # the same rotation
            difference = _difference(a, b)
            allowed = tolerance.absolute + tolerance.relative * np.abs(a)
        largest = max(largest, float(difference.max(initial=0.0)))
        if np.any((difference > allowed) | np.isinf(difference)):
            differing += 1
            first = stamp if first is None else first
    return FieldResult(topic, field.name, tolerance.unit, len(pairs), differing, largest, first)


def _compare_rest(topic: str, known: Sequence[Field], pairs: _Pairs) -> FieldResult:
    """Compare the members without a tolerance, such as names and frames."""
    skipped = {path for field in known for path in field.paths} | {INDEX}
    different = []
    for stamp, old, new in pairs:
        names = (old.keys() | new.keys()) - skipped
        if any(old.get(name) != new.get(name) for name in names):
            different.append(stamp)
    return FieldResult(
        topic,
        "everything else",
        "",
        len(pairs),
        len(different),
        math.inf if different else 0.0,
        different[0] if different else None,
    )


def _numbers(field: Field, values: Values) -> Floats:
    return np.array([values[path] for path in field.paths if path in values], np.float64)


def _difference(a: Floats, b: Floats) -> Floats:
    """Return |a - b|; 0 for equal infinities or two NaN, infinite if only one is a number."""
    with np.errstate(invalid="ignore"):
        difference: Floats = np.abs(a - b)
    difference[(a == b) | (np.isnan(a) & np.isnan(b))] = 0.0
    difference[np.isnan(difference)] = math.inf
    return difference


def _relative_to_sigmas(a: Floats, b: Floats) -> Floats:
    """Return the difference of two flat covariance matrices relative to the sigmas of the first."""
    size = math.isqrt(len(a))
    with np.errstate(invalid="ignore"):
        variances = np.abs(np.diagonal(a.reshape(size, size)))
    sigmas = np.sqrt(np.where(np.isfinite(variances), variances, 1.0))
    scale = np.outer(sigmas, sigmas).ravel()
    difference = _difference(a, b)
    scaled: Floats = np.divide(
        difference, scale, out=np.where(difference > 0.0, math.inf, 0.0), where=scale > 0.0
    )
    return scaled
