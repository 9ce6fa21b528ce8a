from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from made_up_run import header, serialized, status
from needle_bags.format.bag_writer import BagCopy, standard_topic
from needle_bags.run.stage_timing import stage_timings

# Every message of a step begins with its stamp; the timing uses nothing else.
HEADER = "std_msgs/msg/Header"
MILLISECOND = 1_000_000
START = 1_700_000_000_000_000_000
STEPS = 25


LEFT, RIGHT = "stereo/left/camera_info", "stereo/right/camera_info"
STATUS = "diagnostic_msgs/msg/DiagnosticStatus"


def put(bag: BagCopy, topic: str, stamp: int, sent: int, received: int) -> None:
    """Write a message with a stamp."""
    bag.put(standard_topic(f"/rig/{topic}", HEADER), serialized(header(stamp)), received, sent)


def put_status(bag: BagCopy, commanded: int, sent: int, received: int) -> None:
    """Write a status: the device has received commands up to this stamp."""
    data = serialized(status({"command_ns": commanded}))
    bag.put(standard_topic("/rig/device/status", STATUS), data, received, sent)


@pytest.mark.parametrize("exposures", [{LEFT: 0, RIGHT: 3}, {"sim/tip_pose": 3}])
def test_durations_from_the_later_image_to_the_sync_of_the_first_cycle(
    tmp_path: Path, exposures: dict[str, int]
) -> None:
    bag = BagCopy(tmp_path / "bag", "jazzy", {})
    ms = MILLISECOND
    for step in range(STEPS):
        begin = START + step * 100 * ms
        # In real time, a stamp is a time of day. All arrive late and at once, as on a busy machine.
        stamp, received = begin - 10 * ms, begin + 90 * ms
        for topic, delay in exposures.items():
            put(bag, topic, stamp, begin + delay * ms, received)
        put(bag, "needle/tip_pose", stamp, begin + 8 * ms, received)
        put(bag, "device/joint_trajectory", stamp, begin + 10 * ms, received)
        # A cycle is already running when the command is sent: its set-points are older.
        put_status(bag, stamp - 100 * ms, begin + 11 * ms, received)
        put(bag, "joint_states", begin + 9 * ms, begin + 12 * ms, received)
        put_status(bag, stamp, begin + 13 * ms, received)
        put(bag, "joint_states", begin + 19 * ms, begin + 22 * ms, received)
        put(bag, "device/result", stamp, begin + 40 * ms, received)
    bag.close()
    run: Any = SimpleNamespace(path=tmp_path / "bag", namespace="/rig/")
    timings = {timing.name: timing for timing in stage_timings(run)}
    for name, milliseconds in {
        "tracker": 5.0,
        "controller": 2.0,
        "driver": 9.0,
        "image to set-point": 16.0,
        "device": 30.0,
        "camera": 63.0,
    }.items():
        assert timings[name].seconds * 1e3 == pytest.approx(milliseconds)
        assert len(timings[name].stamps) == (STEPS - 1 if name == "camera" else STEPS)
