"""Film of the insertion: exposures of the bag, each with the shape of the needle."""

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

MAX_FRAMES = 61
"""Every 2 mm of 120 mm, and the start."""

READINGS = (
    "Insertion",
    "r1, true",
    "r1, estimated",
    "Pitch, estimated",
    "Roll, estimated",
    "Base turned",
    "Controller",
)
"""Labels of the values shown with each frame."""
_NOTHING = "-"


@dataclasses.dataclass(frozen=True)
class Frame:
    """One exposure.

    Attributes
    ----------
    stamp : int
        Its time, ROS clock [ns].
    shaft : (n, 3) float64
        Measured needle, from the entry point to the tip, in `rig` [m]; empty: no tip.
    needle : (m, 3) float64
        The true needle if the bag has it, otherwise the measured one.
    readings : tuple of str
        Values of `READINGS`, as text.
    """

    stamp: int
    shaft: Floats
    needle: Floats
    readings: tuple[str, ...]


def film_of(run: Run) -> list[Frame]:
    """Return the frames of a run's film, at most `MAX_FRAMES`.

    Each is an exposure of the cameras, or of the simulated sensor without images. They are equally
    spaced by the motion of the needle, so that a resting needle takes no frames.

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
    """Return indices that are equally spaced by the motion of the needle, (N,)."""
    if len(insertion) <= MAX_FRAMES:
        return np.arange(len(insertion))
    travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(insertion)))])
    if not travel[-1] > 0.0:
        travel = np.arange(len(insertion), dtype=np.float64)
    wanted = np.linspace(0.0, travel[-1], MAX_FRAMES)
    return np.unique(np.searchsorted(travel, wanted - 1e-9 * travel[-1]).clip(max=len(travel) - 1))


def _trails(run: Run, series: Series, stamps: Stamps) -> list[Floats]:
    """Return the needle at each stamp, from the entry to the tip; (0, 3) without a tip."""
    insertions = run.insertion_at(series.stamps).tolist()
    wanted = frozenset(stamps.tolist())
    trail = ShaftTrail()
    found: dict[int, Floats] = {}
    for stamp, insertion, row in zip(
        series.stamps.tolist(), insertions, series.values, strict=True
    ):
        position = row[:3]
        if not np.isfinite(position).all():
            continue
        trail.add(insertion, position)
        if stamp in wanted:
            found[stamp] = trail.shaft(insertion, position)
    return [found.get(stamp, np.empty((0, 3))) for stamp in stamps.tolist()]


class _Readings:
    """Values shown with an exposure."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._true_r1 = dict(zip(run.truth.stamps.tolist(), true_r1(run).tolist(), strict=True))
        self._estimates = {stamp: index for index, stamp in enumerate(run.reduced_state.stamps)}
        self._status_times = [status.log_time for status in run.controller_status]

    def at(self, stamp: int) -> tuple[str, ...]:
        run = self._run
        insertion, rotation = run.joints_at(np.array([stamp]))[0].tolist()
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
            controller = _confidence(status)
        return (
            _NOTHING if np.isnan(insertion) else f"{insertion * 1e3:.1f} mm",
            _NOTHING if r1 is None else f"{r1 * 1e3:+.2f} mm",
            *estimated,
            _NOTHING if np.isnan(rotation) else f"{np.degrees(rotation):.0f} deg",
            controller,
        )

    def _status_of(self, index: int) -> Status | None:
        """Return the last controller status before the next estimate."""
        received = self._run.reduced_state.received
        until = int(received[index + 1]) if index + 1 < len(received) else None
        statuses = self._run.controller_status
        last = len(statuses) if until is None else bisect_left(self._status_times, until)
        return statuses[last - 1] if last else None


def _interval(status: Status | None) -> str:
    """Return half of the 95 % interval of r1, as text."""
    if status is None:
        return ""
    try:
        low, high = float(status.values["r1_low_m"]), float(status.values["r1_high_m"])
    except (KeyError, ValueError):
        return ""
    return f" ± {(high - low) / 2 * 1e3:.2f}" if np.isfinite(high - low) else ""


def _confidence(status: Status | None) -> str:
    trusted = status.values.get("trusted", "") if status else ""
    if trusted in ("", "trusted"):
        return trusted or _NOTHING
    return trusted.partition(":")[0]
