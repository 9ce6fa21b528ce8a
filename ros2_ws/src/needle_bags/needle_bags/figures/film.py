"""A film of the insertion: exposures of the bag, each with where the needle was."""

from __future__ import annotations

import dataclasses
from bisect import bisect_left

import numpy as np
import numpy.typing as npt

from needle_bags.reading.bag_images import TOPICS, exposures
from needle_bags.reading.bag_reader import Run, Series, Stamps, Status
from needle_bags.run.run_summary import true_r1
from needle_bags.run.shaft_trail import ShaftTrail

Floats = npt.NDArray[np.float64]

MOST_FRAMES = 61
"""Every 2 mm of 120 mm, and the needle before it goes in."""

READINGS = (
    "Insertion",
    "r1, true",
    "r1, estimated",
    "Pitch, estimated",
    "Roll, estimated",
    "Base turned",
    "Controller",
)
"""What is told of each frame."""
_NOTHING = "-"


@dataclasses.dataclass(frozen=True)
class Frame:
    """One exposure.

    Attributes
    ----------
    stamp : int
        Its time, ROS clock [ns].
    shaft : (n, 3) float64
        Needle as measured, from the entry point to the tip, in `rig` [m]; empty: no tip.
    needle : (m, 3) float64
        The true one where the bag has it, else the measured one.
    readings : tuple of str
        Values of `READINGS`, for people.
    """

    stamp: int
    shaft: Floats
    needle: Floats
    readings: tuple[str, ...]


def film_of(run: Run) -> list[Frame]:
    """Return the frames of a run's film in their order, `MOST_FRAMES` at most.

    Each is an exposure of the bag: of its cameras, or without images of what measured the tip. They
    are equally far apart by how far the needle was moved, so that no time is spent where it rests.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    has_images = any(run.topics.get(run.namespace + topic) for topic in TOPICS)
    all_stamps = exposures(run) if has_images else run.tips.stamps
    stamps = all_stamps[_spread(run.insertion_at(all_stamps))]
    measured = _trails(run, run.tips, stamps)
    true = _trails(run, run.truth, stamps) if len(run.truth) else measured
    readings = _Readings(run)
    return [
        Frame(int(stamp), shaft, needle, readings.at(int(stamp)))
        for stamp, shaft, needle in zip(stamps, measured, true, strict=True)
    ]


def _spread(insertion: Floats) -> npt.NDArray[np.int64]:
    """Return indices that are equally far apart in how far the needle was moved, (N,)."""
    if len(insertion) <= MOST_FRAMES:
        return np.arange(len(insertion))
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(insertion)))])
    if not way[-1] > 0.0:
        way = np.arange(len(insertion), dtype=np.float64)
    wanted = np.linspace(0.0, way[-1], MOST_FRAMES)
    return np.unique(np.searchsorted(way, wanted - 1e-9 * way[-1]).clip(max=len(way) - 1))


def _trails(run: Run, series: Series, stamps: Stamps) -> list[Floats]:
    """Return the needle at each stamp, from the entry to the tip of that stamp; (0, 3): no tip."""
    insertions = run.insertion_at(series.stamps).tolist()
    wanted = frozenset(stamps.tolist())
    trail = ShaftTrail()
    found: dict[int, Floats] = {}
    for stamp, insertion, row in zip(
        series.stamps.tolist(), insertions, series.values, strict=True
    ):
        place = row[:3]
        if not np.isfinite(place).all():
            continue
        trail.add(insertion, place)
        if stamp in wanted:
            found[stamp] = trail.shaft(insertion, place)
    return [found.get(stamp, np.empty((0, 3))) for stamp in stamps.tolist()]


class _Readings:
    """Readings of an exposure."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._true_r1 = dict(zip(run.truth.stamps.tolist(), true_r1(run).tolist(), strict=True))
        self._estimates = {stamp: index for index, stamp in enumerate(run.reduced_state.stamps)}
        self._told_at = [status.log_time for status in run.controller_status]

    def at(self, stamp: int) -> tuple[str, ...]:
        run = self._run
        insertion = float(run.insertion_at(np.array([stamp]))[0])
        base = _NOTHING
        if len(run.joints):
            times, turns = run.joints.stamps - run.joints.stamps[0], run.joints.values[:, 1]
            turned = np.interp(float(stamp - run.joints.stamps[0]), times.astype(float), turns)
            base = f"{np.degrees(turned):.0f} deg"
        r1 = self._true_r1.get(stamp)
        index = self._estimates.get(stamp)
        estimated, controller = (_NOTHING,) * 3, _NOTHING
        if index is not None:
            status = self._status_of(index)
            x, pitch, roll = run.reduced_state.values[index].tolist()
            estimated = (
                f"{x * 1e3:+.2f} mm{_interval(status)}",
                f"{np.degrees(pitch):+.1f} deg",
                f"{np.degrees(roll):+.0f} deg",
            )
            controller = _belief(status)
        return (
            _NOTHING if np.isnan(insertion) else f"{insertion * 1e3:.1f} mm",
            _NOTHING if r1 is None else f"{r1 * 1e3:+.2f} mm",
            *estimated,
            base,
            controller,
        )

    def _status_of(self, index: int) -> Status | None:
        """Return what the controller said last before it had the next estimate."""
        received = self._run.reduced_state.received
        until = int(received[index + 1]) if index + 1 < len(received) else None
        told = self._run.controller_status
        last = len(told) if until is None else bisect_left(self._told_at, until)
        return told[last - 1] if last else None


def _interval(status: Status | None) -> str:
    """Return half of the interval that holds r1 with 95 %."""
    if status is None:
        return ""
    try:
        low, high = float(status.values["r1_low_m"]), float(status.values["r1_high_m"])
    except (KeyError, ValueError):
        return ""
    return f" ± {(high - low) / 2 * 1e3:.2f}" if np.isfinite(high - low) else ""


def _belief(status: Status | None) -> str:
    said = status.values.get("trusted", "") if status else ""
    if said in ("", "trusted"):
        return said or _NOTHING
    return said.partition(":")[0]
