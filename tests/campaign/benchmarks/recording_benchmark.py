"""The recorder compared with rosbags' writer, the disk alone and the images sent."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from campaign.benchmarks.figure_rows import Row
from campaign.trials.recording_trials import record_full_rate
from needle_bags.format.bag_writer import BagWriter, standard_topic
from needle_bags.recording.recording import reuse_freed_memory

EXPOSURES = 150
SECONDS = 20.0
SMALL_EACH = 10
_IMAGE = "sensor_msgs/msg/Image"
_SMALL = "sensor_msgs/msg/JointState"
_TOPICS = (("/left", _IMAGE), ("/right", _IMAGE), ("/joint_states", _SMALL))
_START = 1_700_000_000_000_000_000
_STORE = get_typestore(Stores.ROS2_JAZZY)

Message = tuple[int, int, bytes]


def writer_rows() -> Iterator[Row]:
    """Yield the time to write stereo pairs and small messages to the disk, fsync included."""
    reuse_freed_memory()  # as the recorder does
    images = np.random.default_rng(1).integers(0, 256, (2, 1024 * 768 + 64), dtype=np.uint8)
    left, right = (image.tobytes() for image in images)
    small = images[0, :200].tobytes()

    def messages() -> Iterator[Message]:
        for number in range(EXPOSURES):
            time_ns = _START + number * 33_000_000
            yield 0, time_ns, left
            yield 1, time_ns, right
            for _ in range(SMALL_EACH):
                yield 2, time_ns, small

    size = sum(len(data) for _, _, data in messages()) / 1e6
    writers = (_record, _write_rosbags, _write_plainly)
    # The writers take turns, so that other load on the machine affects all of them.
    seconds = [[_timed(write, messages) for write in writers] for _ in range(3)]
    recorder, rosbags, disk = (min(times) for times in zip(*seconds, strict=True))
    what = f"recorder's writer, {size:.0f} MB"
    yield Row("recording", what, "s", recorder, "rosbags Writer", rosbags)
    yield Row("recording", what, "s", recorder, "the disk alone", disk)


def _timed(
    write: Callable[[Path, Iterator[Message]], None], messages: Callable[[], Iterator[Message]]
) -> float:
    folder = Path(tempfile.mkdtemp(prefix="needle_bench_"))
    try:
        begin = time.perf_counter()
        write(folder / "bag", messages())
        for file in (folder / "bag").iterdir():
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
        return time.perf_counter() - begin
    finally:
        shutil.rmtree(folder)


def _record(path: Path, messages: Iterator[Message]) -> None:
    bag = BagWriter(path)
    topics = [bag.add_topic(standard_topic(name, kind)) for name, kind in _TOPICS]
    for topic, time_ns, data in messages:
        bag.write(topics[topic], data, time_ns, time_ns)
    bag.close()


def _write_rosbags(path: Path, messages: Iterator[Message]) -> None:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = [bag.add_connection(name, kind, typestore=_STORE) for name, kind in _TOPICS]
        for topic, time_ns, data in messages:
            bag.write(topics[topic], time_ns, data)


def _write_plainly(path: Path, messages: Iterator[Message]) -> None:
    path.mkdir()
    with (path / "data").open("wb") as stream:
        for _, _, data in messages:
            stream.write(data)


def reception_rows() -> Iterator[Row]:
    """Yield the recorded share of stereo images at 2 x 30 Hz over DDS, and the CPU share."""
    with tempfile.TemporaryDirectory(prefix="needle_bench_") as folder:
        found = record_full_rate(Path(folder), SECONDS, others=0)
    images = 2 * 30.0 * SECONDS
    lost = sum(found["missing"].get(f"/stereo/{side}/image_raw", 0) for side in ("left", "right"))
    recorded = 100.0 * (1.0 - lost / images)
    yield Row("stereo_received", "stereo recorded", "%", recorded, "images sent", 100.0)
    core = 100.0 * found["share"]
    yield Row("recorder_core", "recorder, share of a core", "%", core, "one core", 100.0)
