"""Duration of each stage of a step, by when its messages were sent."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
import numpy.typing as npt

from needle_bags.format.bag_copy import stamp_of
from needle_bags.reading.bag_order import raw_as_sent
from needle_bags.reading.bag_reader import Run

Floats = npt.NDArray[np.float64]

_EXPOSURE = ("stereo/left/camera_info", "sim/tip_pose")
_TIP, _COMMAND, _RESULT = "needle/tip_pose", "device/joint_trajectory", "device/result"
STAGES = (
    ("tracker", "exposure to tip"),
    ("controller", "tip to command"),
    ("device", "command to result: the motion"),
    ("camera", "result to next exposure"),
)
"""Name and meaning of each stage."""


@dataclasses.dataclass(frozen=True)
class StageTiming:
    """One stage's durations.

    Attributes
    ----------
    name, meaning : str
        Which stage, and from what to what.
    stamps : (N,) int64
        The exposure at which the step began [ns].
    seconds : (N,) float64
        Wall time [s].
    """

    name: str
    meaning: str
    stamps: npt.NDArray[np.int64]
    seconds: Floats


def stage_timings(run: Run) -> list[StageTiming]:
    """Return the stages of a run that its bag tells of.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    sent = _first_sent(run)
    exposed = sent[_EXPOSURE[0]] or sent[_EXPOSURE[1]]
    ends = ((exposed, sent[_TIP]), (sent[_TIP], sent[_COMMAND]), (sent[_COMMAND], sent[_RESULT]))
    durations = [{stamp: b[stamp] - a[stamp] for stamp in a.keys() & b.keys()} for a, b in ends]
    durations.append(_waits(sent[_RESULT], exposed))
    timings = []
    for (name, meaning), found in zip(STAGES, durations, strict=True):
        stamps = np.array(sorted(found), np.int64)
        seconds = np.array([found[int(stamp)] * 1e-9 for stamp in stamps], np.float64)
        if len(stamps):
            timings.append(StageTiming(name, meaning, stamps, seconds))
    return timings


def _first_sent(run: Run) -> dict[str, dict[int, int]]:
    """Return relative topic -> stamp -> when the first message with that stamp was sent."""
    names = {run.namespace + name: name for name in (*_EXPOSURE, _TIP, _COMMAND, _RESULT)}
    sent: dict[str, dict[int, int]] = defaultdict(dict)
    for message in raw_as_sent(run.path, names.__contains__, lambda _: False):
        sent[names[message.topic]].setdefault(stamp_of(message.data), message.time)
    return sent


def _waits(results: dict[int, int], exposed: dict[int, int]) -> dict[int, int]:
    """Return by command how long after its result the next exposure was sent [ns]."""
    times = np.sort(np.array(list(exposed.values()), np.int64))
    waits = {}
    for stamp, time in results.items():
        after = int(np.searchsorted(times, time))
        if after < len(times):
            waits[stamp] = int(times[after]) - time
    return waits
