"""Duration of each stage of a step or path, by when its messages were sent.

A cycle of the driver ends with its joint_states: the first sent after a command follow the first
set-points made from it.
"""

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
_JOINTS = "joint_states"
STAGES = (
    ("tracker", "exposure to tip"),
    ("controller", "tip to command"),
    ("driver", "command to the end of the cycle with its first set-points"),
    ("image to set-point", "all of these; at 5 mm/s each 10 ms are 0.05 mm"),
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
    tips, commands, results = sent[_TIP], sent[_COMMAND], sent[_RESULT]
    to_set_points = _waits(commands, sent[_JOINTS])
    set_points = {stamp: commands[stamp] + wait for stamp, wait in to_set_points.items()}
    durations = [
        _between(exposed, tips),
        _between(tips, commands),
        to_set_points,
        _between(exposed, set_points),
        _between(commands, results),
        _waits(results, exposed),
    ]
    timings = []
    for (name, meaning), found in zip(STAGES, durations, strict=True):
        stamps = np.array(sorted(found), np.int64)
        seconds = np.array([found[int(stamp)] * 1e-9 for stamp in stamps], np.float64)
        if len(stamps):
            timings.append(StageTiming(name, meaning, stamps, seconds))
    return timings


def _first_sent(run: Run) -> dict[str, dict[int, int]]:
    """Return relative topic -> stamp -> when the first message with that stamp was sent."""
    topics = (*_EXPOSURE, _TIP, _COMMAND, _RESULT, _JOINTS)
    names = {run.namespace + name: name for name in topics}
    sent: dict[str, dict[int, int]] = defaultdict(dict)
    for message in raw_as_sent(run.path, names.__contains__, lambda _: False):
        sent[names[message.topic]].setdefault(stamp_of(message.data), message.time)
    return sent


def _between(begins: dict[int, int], ends: dict[int, int]) -> dict[int, int]:
    """Return by stamp how long after one message the other with that stamp was sent [ns]."""
    return {stamp: ends[stamp] - begins[stamp] for stamp in begins.keys() & ends.keys()}


def _waits(begins: dict[int, int], ends: dict[int, int]) -> dict[int, int]:
    """Return by stamp how long after a message any of the others was sent next [ns]."""
    times = np.sort(np.array(list(ends.values()), np.int64))
    waits = {}
    for stamp, time in begins.items():
        after = int(np.searchsorted(times, time))
        if after < len(times):
            waits[stamp] = int(times[after]) - time
    return waits
