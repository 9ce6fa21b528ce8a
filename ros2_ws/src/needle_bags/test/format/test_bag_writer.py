from __future__ import annotations

import errno
import io
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosHistory, QosReliability, QosTime
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter
from needle_bags.format.message_definitions import full_definition
from needle_bags.recording.free_space import FreeSpace
from needle_bags.recording.recording import (
    WAITING_LIMIT,
    Received,
    Recording,
    open_recording,
)
from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TIME = 1_700_000_000_000_000_000
RIG_TYPES = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Joy",
    "geometry_msgs/msg/PointStamped",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/Vector3Stamped",
    "std_msgs/msg/Bool",
    "std_msgs/msg/Header",
    "trajectory_msgs/msg/JointTrajectory",
    "diagnostic_msgs/msg/DiagnosticStatus",
    "diagnostic_msgs/msg/DiagnosticArray",
    "rosgraph_msgs/msg/Clock",
    "rcl_interfaces/msg/ParameterEvent",
    "rcl_interfaces/msg/Log",
)


def pose(number: int) -> bytes:
    types = STORE.types
    message = types[TYPE](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=number, nanosec=5), frame_id="rig"
        ),
        pose=types["geometry_msgs/msg/PoseWithCovariance"](
            pose=types["geometry_msgs/msg/Pose"](
                position=types["geometry_msgs/msg/Point"](x=0.001 * number, y=0.0, z=0.0),
                orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            ),
            covariance=np.arange(36.0),
        ),
    )
    return bytes(STORE.serialize_cdr(message, TYPE))


def write_poses(directory: Path, count: int) -> None:
    bag = BagWriter(directory, chunk_size=4096)
    qos = (
        USUAL_QOS._replace(history=QosHistory.KEEP_LAST, depth=10),
        USUAL_QOS._replace(
            reliability=QosReliability.BEST_EFFORT,
            durability=QosDurability.TRANSIENT_LOCAL,
            lifespan=QosTime(10, 7),
        ),
    )
    topic = BagTopic("/needle/tip_pose", TYPE, full_definition(TYPE), STORE.hash_rihs01(TYPE), qos)
    channel = bag.add_topic(topic)
    for number in range(count):
        bag.write(channel, pose(number), TIME + number * 1000, TIME + number * 1000 - 10)
    bag.set_custom_data("run_info", "level: tip\nseed: 1\n")
    bag.add_attachment("calibration.yaml", "application/yaml", b"left: {}\n", TIME)
    bag.close()


@pytest.mark.parametrize("type_name", RIG_TYPES)
def test_definitions_hash_as_rosbags_computes(type_name: str) -> None:
    types = get_types_from_msg(full_definition(type_name), type_name)
    fresh = get_typestore(Stores.EMPTY)
    fresh.register(types)
    assert fresh.hash_rihs01(type_name) == STORE.hash_rihs01(type_name)


def test_round_trip_with_rosbags(tmp_path: Path) -> None:
    write_poses(tmp_path / "bag", 500)
    with AnyReader([tmp_path / "bag"]) as reader:
        messages = list(reader.messages())
        assert reader.message_count == 500
        assert [time for _, time, _ in messages] == [TIME + n * 1000 for n in range(500)]
        assert [bytes(data) for _, _, data in messages] == [pose(n) for n in range(500)]
        connection, _, data = messages[-1]
        last: Any = reader.deserialize(data, connection.msgtype)
        assert last.header.stamp.sec == 499


def test_topic_metadata_read_by_rosbags(tmp_path: Path) -> None:
    write_poses(tmp_path / "bag", 3)
    with Reader(tmp_path / "bag") as reader:
        (connection,) = reader.connections
        assert connection.digest == STORE.hash_rihs01(TYPE)
        assert reader.ros_distro == "jazzy"
        first, second = connection.ext.offered_qos_profiles  # type: ignore[union-attr]
        assert (first.history, first.depth) == (QosHistory.KEEP_LAST, 10)
        assert first.reliability is QosReliability.RELIABLE
        assert second.reliability is QosReliability.BEST_EFFORT
        assert second.durability is QosDurability.TRANSIENT_LOCAL
        assert (second.lifespan.sec, second.lifespan.nsec) == (10, 7)
        assert (first.deadline.sec, first.deadline.nsec) == (9223372036, 854775807)


def test_read_by_mcap(tmp_path: Path) -> None:
    write_poses(tmp_path / "bag", 200)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 200
        messages = list(reader.iter_messages())
        (attachment,) = reader.iter_attachments()
    schema, channel, message = messages[7]
    assert schema is not None
    assert (schema.name, schema.encoding) == (TYPE, "ros2msg")
    assert channel.metadata["topic_type_hash"] == STORE.hash_rihs01(TYPE)
    assert (message.log_time, message.publish_time) == (TIME + 7000, TIME + 6990)
    assert attachment.data == b"left: {}\n"


def test_metadata_has_no_anchors_and_keeps_texts(tmp_path: Path) -> None:
    write_poses(tmp_path / "bag", 1)
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    assert "&id" not in text
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["custom_data"] == {"run_info": "level: tip\nseed: 1\n"}


def test_empty_bag_opens(tmp_path: Path) -> None:
    BagWriter(tmp_path / "bag").close()
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 0


def test_existing_bag_is_refused(tmp_path: Path) -> None:
    write_poses(tmp_path / "bag", 1)
    with pytest.raises(UserError, match="holds a bag already"):
        BagWriter(tmp_path / "bag")


def test_a_folder_without_a_bag_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "parameters.yaml").write_text("{}")
    BagWriter(tmp_path).close()
    assert (tmp_path / "metadata.yaml").is_file()


def test_unknown_type_is_named() -> None:
    with pytest.raises(UserError, match="no_such_msgs/msg/Thing is not installed"):
        full_definition("no_such_msgs/msg/Thing")


def test_a_disk_that_takes_nothing_is_said_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not after a run of which nothing was kept; and nothing stands in the way of the next try."""
    monkeypatch.setattr(BagWriter, "open_file", lambda _, path: _BrokenFile(path, "xb"))
    with pytest.raises(UserError, match=r"cannot record into .*bag: Input/output error"):
        open_recording(tmp_path / "bag")
    monkeypatch.undo()
    open_recording(tmp_path / "bag").close()


class _BrokenFile(io.FileIO):
    def write(self, _: object) -> int:
        raise OSError(errno.EIO, "Input/output error")


def test_a_full_disk_ends_the_recording_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    recording = open_recording(tmp_path / "bag")
    recording.add_topic(BagTopic("/t", TYPE, full_definition(TYPE)))
    monkeypatch.setattr("mcap.writer.Writer.add_message", full)
    for number in range(10):
        recording.append(Received("/t", pose(number), TIME, TIME))
    recording.close()
    assert recording.error is not None
    assert recording.error.endswith("bag_0.mcap: No space left on device")


def test_what_a_disk_that_fills_at_the_very_end_drops_is_named_in_the_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = Writer.finish

    def full_once(writer: Writer) -> None:
        monkeypatch.setattr(Writer, "finish", finish)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(BagWriter, "flush", lambda _: None)
    monkeypatch.setattr(Writer, "finish", full_once)
    recording = open_recording(tmp_path / "bag")
    recording.add_topic(BagTopic("/t", TYPE, full_definition(TYPE)))
    for number in range(10):
        recording.append(Received("/t", pose(number), TIME, TIME))
    recording.close({"/t": 2, "/other": 1})
    assert recording.is_whole
    text = (tmp_path / "bag" / "metadata.yaml").read_text()
    custom = yaml.safe_load(text)["rosbag2_bagfile_information"]["custom_data"]
    assert json.loads(custom["messages_lost"]) == {"/t": 12, "/other": 1}


def test_a_recording_keeps_room_for_what_is_small_and_counts_what_it_drops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that stands still: images fill the memory that there is, commands still get in."""
    moves = threading.Event()
    write = BagWriter.write

    def slow(*given: Any) -> None:
        assert moves.wait(20.0)
        write(*given)

    monkeypatch.setattr(BagWriter, "write", slow)
    recording = open_recording(tmp_path / "bag")
    for name in ("/image", "/command"):
        recording.add_topic(BagTopic(name, TYPE, full_definition(TYPE)))
    image = bytes(WAITING_LIMIT // 8)
    for _ in range(12):
        recording.append(Received("/image", image, TIME, TIME))
    for _ in range(100):
        recording.append(Received("/command", pose(1), TIME, TIME))
    assert recording.bytes_waiting < 1.2 * WAITING_LIMIT
    assert recording.dropped.keys() == {"/image"}
    dropped = recording.dropped["/image"]
    moves.set()
    recording.close()
    assert recording.is_whole
    with Reader(tmp_path / "bag") as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts == {"/image": 12 - dropped, "/command": 100}


def test_a_flood_of_tiny_messages_is_bounded_by_what_they_take_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moves = threading.Event()
    monkeypatch.setattr(BagWriter, "write", lambda *_: moves.wait(20.0))
    space = FreeSpace(tmp_path, 0)
    recording = Recording(BagWriter(tmp_path / "bag"), space, waiting_limit=900_000)
    recording.add_topic(BagTopic("/t", TYPE, full_definition(TYPE)))
    for _ in range(5000):
        recording.append(Received("/t", b"", TIME, TIME))
    assert 1000 < recording.messages_waiting < 1400
    assert recording.dropped["/t"] + recording.messages_received == 5000
    moves.set()
    recording.close()


def test_a_message_that_cannot_be_written_ends_the_recording_in_order(tmp_path: Path) -> None:
    """The thread that writes may not end in silence: all that comes after would wait for ever."""
    recording = open_recording(tmp_path / "bag")
    recording.add_topic(BagTopic("/t", TYPE, full_definition(TYPE)))
    recording.append(Received("/t", pose(1), TIME, TIME))
    recording.append(Received("/nobody_described_it", pose(2), TIME, TIME))
    recording.append(Received("/t", pose(3), TIME, TIME))
    recording.close()
    assert recording.error == "KeyError: '/nobody_described_it'"
    assert recording.is_whole
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 1
