"""Duration of each stage of a step or path, by when its messages were sent.

A cycle of the driver ends with its joint_states. The first that it sends once its status has said
that it heard a command are of the first cycle whose set-points were made from it. On a rig their
stamp is when the SYNC behind these set-points was written; in simulated time the stamp is no time
of day, and the end of the cycle stands for it.
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

# Each side's goes with its image, and is quicker read.
_IMAGES = ("stereo/left/camera_info", "stereo/right/camera_info")
_EXPOSURE = "sim/tip_pose"
_TIP, _COMMAND, _RESULT = "needle/tip_pose", "device/joint_trajectory", "device/result"
_JOINTS, _STATUS = "joint_states", "device/status"
# A stamp that is no older when it is sent is a time of day [ns].
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
    left, right = (sent[topic] for topic in _IMAGES)
    # Of cameras that run freely each has stamps of its own; a pair's is the left one's.
    exposed = {stamp: max(time, right.get(stamp, time)) for stamp, time in left.items()}
    exposed = exposed or sent[_EXPOSURE]
    tips, commands, results = sent[_TIP], sent[_COMMAND], sent[_RESULT]
    set_points = _set_points(commands, _hearings(run), sent[_JOINTS])
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
    """Return relative topic -> stamp -> when the first message with that stamp was sent."""
    topics = (*_IMAGES, _EXPOSURE, _TIP, _COMMAND, _RESULT, _JOINTS)
    names = {run.namespace + name: name for name in topics}
    sent: dict[str, dict[int, int]] = defaultdict(dict)
    for message in raw_as_sent(run.path, names.__contains__, lambda _: False):
        sent[names[message.topic]].setdefault(stamp_of(message.data), message.time)
    return sent


def _hearings(run: Run) -> tuple[Times, Times]:
    """Return when the device said that it had heard commands, (N,), and up to which stamp."""
    said, heard = [], []
    status = run.namespace + _STATUS
    for sent, message in messages_as_sent(run.path, status.__eq__, lambda _: False):
        values = {pair.key: pair.value for pair in message.values}
        said.append(sent.time)
        heard.append(int(values.get("command_ns") or 0))
    return np.array(said, np.int64), np.maximum.accumulate(np.array(heard, np.int64))


def _set_points(
    commands: dict[int, int], hearings: tuple[Times, Times], joints: dict[int, int]
) -> dict[int, int]:
    """Return by a command's stamp when its first set-points were on the bus [ns]."""
    said, heard = hearings
    cycles = sorted((sent, stamp) for stamp, sent in joints.items())
    ends = np.array([sent for sent, _ in cycles], np.int64)
    set_points = {}
    for stamp, time in commands.items():
        first = int(np.searchsorted(heard, stamp))
        known = time if first == len(said) else max(int(said[first]), time)
        cycle = int(np.searchsorted(ends, known))
        if cycle < len(cycles):
            sent, sync = cycles[cycle]
            set_points[stamp] = sync if 0 <= sent - sync < _FRESH else sent
    return set_points


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
