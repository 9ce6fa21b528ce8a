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
PERIOD, TRACKER, CONTROLLER, DRIVER, DEVICE = 100.0, 7.0, 2.0, 12.0, 30.0
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


def write(directory: Path, exposure: str) -> Any:
    """Write steps of 100 ms: exposure, then tip, command, joints and result with fixed delays."""
    bag = BagCopy(directory, "jazzy", {})
    for step in range(STEPS):
        sent = START + round(step * PERIOD * MILLISECOND)
        for topic, delay in (
            (exposure, 0.0),
            ("needle/tip_pose", TRACKER),
            ("device/joint_trajectory", CONTROLLER),
            ("joint_states", DRIVER),
            ("device/result", DEVICE - DRIVER),
        ):
            sent += round(delay * MILLISECOND)
            # All received late and at once, as on a busy machine.
            received = START + round((step * PERIOD + 60.0) * MILLISECOND)
            put(bag, topic, step * 1_000_000_000, sent, received)
    bag.close()
    return SimpleNamespace(path=directory, namespace="/rig/")


@pytest.mark.parametrize("exposure", [LEFT, "sim/tip_pose"])
def test_durations_of_the_stages(tmp_path: Path, exposure: str) -> None:
    timings = {timing.name: timing for timing in stage_timings(write(tmp_path / "bag", exposure))}
    for name, milliseconds in {
        "tracker": TRACKER,
        "controller": CONTROLLER,
        "driver": DRIVER,
        "image to set-point": TRACKER + CONTROLLER + DRIVER,
        "device": DEVICE,
        "camera": PERIOD - TRACKER - CONTROLLER - DEVICE,
    }.items():
        assert timings[name].seconds * 1e3 == pytest.approx(milliseconds)
        assert len(timings[name].stamps) == (STEPS - 1 if name == "camera" else STEPS)


def test_latency_from_the_later_image_to_the_sync_of_the_first_cycle(
    tmp_path: Path,
) -> None:
    bag = BagCopy(tmp_path / "bag", "jazzy", {})
    ms = MILLISECOND
    for step in range(STEPS):
        begin = START + step * 100 * ms
        # In real time, a stamp is a time of day.
        stamp = begin - 10 * ms
        received = begin + 90 * ms
        put(bag, LEFT, stamp, begin, received)
        put(bag, RIGHT, stamp, begin + 3 * ms, received)
        put(bag, "needle/tip_pose", stamp, begin + 8 * ms, received)
        put(bag, "device/joint_trajectory", stamp, begin + 10 * ms, received)
        # A cycle is already running when the command is sent: its set-points are older.
        put_status(bag, stamp - 100 * ms, begin + 11 * ms, received)
        put(bag, "joint_states", begin + 9 * ms, begin + 12 * ms, received)
        put_status(bag, stamp, begin + 13 * ms, received)
        put(bag, "joint_states", begin + 19 * ms, begin + 22 * ms, received)
    bag.close()
    run: Any = SimpleNamespace(path=tmp_path / "bag", namespace="/rig/")
    timings = {timing.name: timing.seconds * 1e3 for timing in stage_timings(run)}
    assert timings["tracker"] == pytest.approx(5.0)
    assert timings["controller"] == pytest.approx(2.0)
    assert timings["driver"] == pytest.approx(9.0)
    assert timings["image to set-point"] == pytest.approx(16.0)
