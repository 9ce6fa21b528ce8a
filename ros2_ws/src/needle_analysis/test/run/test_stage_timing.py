from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from needle_analysis.run.stage_timing import stage_timings
from needle_bags.format.bag_copy import BagCopy, standard_topic

STORE = get_typestore(Stores.ROS2_JAZZY)
# Every message of a step begins with its stamp, and of that alone the timing is made.
HEADER = "std_msgs/msg/Header"
MILLISECOND = 1_000_000
START = 1_700_000_000_000_000_000
PERIOD, TRACKER, CONTROLLER, DRIVER, DEVICE = 100.0, 7.0, 2.0, 12.0, 30.0
STEPS = 25


def write(directory: Path, exposure: str) -> Any:
    """Steps of 100 ms: exposure, then tip, command, joints and result, each so much later."""
    bag = BagCopy(directory, "jazzy", {})
    for step in range(STEPS):
        sent = START + round(step * PERIOD * MILLISECOND)
        time = STORE.types["builtin_interfaces/msg/Time"](sec=step, nanosec=0)
        data = bytes(STORE.serialize_cdr(STORE.types[HEADER](stamp=time, frame_id=""), HEADER))
        for topic, delay in (
            (exposure, 0.0),
            ("needle/tip_pose", TRACKER),
            ("device/joint_trajectory", CONTROLLER),
            ("joint_states", DRIVER),
            ("device/result", DEVICE - DRIVER),
        ):
            sent += round(delay * MILLISECOND)
            # Received late and all at once, as on a busy machine.
            received = START + round((step * PERIOD + 60.0) * MILLISECOND)
            bag.put(standard_topic(f"/rig/{topic}", HEADER), data, received, sent)
    bag.close()
    return SimpleNamespace(path=directory, namespace="/rig/")


@pytest.mark.parametrize("exposure", ["stereo/left/camera_info", "sim/tip_pose"])
def test_stages_take_what_they_took(tmp_path: Path, exposure: str) -> None:
    timings = {timing.name: timing for timing in stage_timings(write(tmp_path / "bag", exposure))}
    wait = PERIOD - TRACKER - CONTROLLER - DEVICE
    wanted = {
        "tracker": TRACKER,
        "controller": CONTROLLER,
        "driver": DRIVER,
        "image to set-point": TRACKER + CONTROLLER + DRIVER,
        "device": DEVICE,
        "camera": wait,
    }
    for name, milliseconds in wanted.items():
        assert timings[name].seconds * 1e3 == pytest.approx(milliseconds)
        assert len(timings[name].stamps) == (STEPS - 1 if name == "camera" else STEPS)
