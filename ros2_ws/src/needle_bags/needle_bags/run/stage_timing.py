"""Duration of each stage of a step or path, from the send times of its messages.

A driver cycle ends with its joint_states. The first joint_states after the status that reports a
command belong to the first cycle with set-points from it. On a rig, their stamp is the time of the
SYNC after these set-points; in simulated time, the end of the cycle is used instead.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
import numpy.typing as npt

from needle_bags.format.bag_writer import stamp_of
from needle_bags.reading.bag_messages import messages_as_sent, raw_as_sent
from needle_bags.reading.bag_reader import Run

Floats = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

# Published with each image, but faster to read.
_IMAGES = ("stereo/left/camera_info", "stereo/right/camera_info")
_EXPOSURE = "sim/tip_pose"
_TIP, _COMMAND, _RESULT = "needle/tip_pose", "device/joint_trajectory", "device/result"
_JOINTS, _STATUS = "joint_states", "device/status"
# A stamp older than this is in simulated time [ns].
_FRESH = 1_000_000_000
STAGES = (
    ("tracker", "both images to tip"),
    ("controller", "tip to command"),
    ("driver", "command to its first set-points on the bus"),
    ("image to set-point", "all of these; at 5 mm/s each 10 ms are 0.05 mm"),
    ("device", "command to result: the motion"),
    ("camera", "result to next exposure"),
)
"""Name and meaning of each stage."""


@dataclasses.dataclass(frozen=True)
class StageTiming:
    """Durations of a stage.

    Attributes
    ----------
    name, meaning : str
        Name of the stage, and its first and last event.
    stamps : (N,) int64
        Time of exposure at the start of the step [ns].
    seconds : (N,) float64
        Wall time [s].
    """

    name: str
    meaning: str
    stamps: npt.NDArray[np.int64]
    seconds: Floats


def stage_timings(run: Run) -> list[StageTiming]:
    """Return the timings of the stages that the bag contains.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    sent = _first_sent(run)
    left, right = (sent[topic] for topic in _IMAGES)
    # Images of free-running cameras have different stamps; a pair has that of the left image.
    exposed = {stamp: max(time, right.get(stamp, time)) for stamp, time in left.items()}
    exposed = exposed or sent[_EXPOSURE]
    tips, commands, results = sent[_TIP], sent[_COMMAND], sent[_RESULT]
    set_points = _set_points(commands, _received_commands(run), sent[_JOINTS])
    durations = [
        _between(exposed, tips),
        _between(tips, commands),
        _between(commands, set_points),
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
    """Return the send time of the first message, by relative topic and stamp [ns]."""
    topics = (*_IMAGES, _EXPOSURE, _TIP, _COMMAND, _RESULT, _JOINTS)
    names = {run.namespace + name: name for name in topics}
    sent: dict[str, dict[int, int]] = defaultdict(dict)
    for message in raw_as_sent(run.path, names.__contains__):
        sent[names[message.topic]].setdefault(stamp_of(message.data), message.time)
    return sent


def _received_commands(run: Run) -> tuple[Times, Times]:
    """Return the send times of device statuses, (N,), and the latest command stamps in them."""
    reported_at, latest_stamps = [], []
    status = run.namespace + _STATUS
    for sent, message in messages_as_sent(run.path, status.__eq__):
        values = {pair.key: pair.value for pair in message.values}
        reported_at.append(sent.time)
        latest_stamps.append(int(values.get("command_ns") or 0))
    return np.array(reported_at, np.int64), np.maximum.accumulate(np.array(latest_stamps, np.int64))


def _set_points(
    commands: dict[int, int], received_commands: tuple[Times, Times], joints: dict[int, int]
) -> dict[int, int]:
    """Return the time of the first set-points on the bus, by command stamp [ns]."""
    reported_at, latest_stamps = received_commands
    cycles = sorted((sent, stamp) for stamp, sent in joints.items())
    ends = np.array([sent for sent, _ in cycles], np.int64)
    set_points = {}
    for stamp, time in commands.items():
        first = int(np.searchsorted(latest_stamps, stamp))
        known = time if first == len(reported_at) else max(int(reported_at[first]), time)
        cycle = int(np.searchsorted(ends, known))
        if cycle < len(cycles):
            sent, sync = cycles[cycle]
            set_points[stamp] = sync if 0 <= sent - sync < _FRESH else sent
    return set_points


def _between(begins: dict[int, int], ends: dict[int, int]) -> dict[int, int]:
    """Return the delay between two messages with equal stamps, by stamp [ns]."""
    return {stamp: ends[stamp] - begins[stamp] for stamp in begins.keys() & ends.keys()}


def _waits(begins: dict[int, int], ends: dict[int, int]) -> dict[int, int]:
    """Return the delay from each message to the next message in `ends`, by stamp [ns]."""
    times = np.sort(np.array(list(ends.values()), np.int64))
    waits = {}
    for stamp, time in begins.items():
        after = int(np.searchsorted(times, time))
        if after < len(times):
            waits[stamp] = int(times[after]) - time
    return waits
