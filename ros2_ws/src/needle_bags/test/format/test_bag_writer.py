"""Bags as rosbags and mcap read them; recordings on a full, failing or slow disk."""

from __future__ import annotations

import dataclasses
import errno
import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from rosbags.interfaces import QosDurability, QosReliability, QosTime
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from made_up_run import STORE
from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter, standard_topic, string_message
from needle_bags.format.message_definitions import full_definition
from needle_bags.reading.bag_messages import read_contents
from needle_bags.recording import recording as recording_module
from needle_bags.recording.recorder_health import WARN_WAITING, RecorderHealth
from needle_bags.recording.recording import FreeSpace, Received, Recording, open_recording
from needle_bags.recording.worker import Job, RunJob
from needle_core.diagnostics import Level
from needle_core.errors import UserError

TIME = 1_700_000_000_000_000_000
RIG_TYPES = (
    *(f"sensor_msgs/msg/{name}" for name in ("Image", "CameraInfo", "JointState", "Joy")),
    *(f"geometry_msgs/msg/{name}Stamped" for name in ("Point", "Pose", "Vector3")),
    *(f"std_msgs/msg/{name}" for name in ("Bool", "Header", "String")),
    *(f"rcl_interfaces/msg/{name}" for name in ("ParameterEvent", "Log")),
    *("trajectory_msgs/msg/JointTrajectory", "diagnostic_msgs/msg/DiagnosticArray"),
)
TYPE = "std_msgs/msg/String"
TOPIC = standard_topic("/t", TYPE)


def received(number: int = 1, topic: str = "/t") -> Received:
    return Received(topic, string_message(str(number)), TIME, TIME)


@pytest.fixture(scope="module")
def texts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of 200 texts that uses every feature of the format."""
    directory = tmp_path_factory.mktemp("writer") / "bag"
    bag = BagWriter(directory, chunk_size=4096)
    offered: Any = {"reliability": QosReliability.BEST_EFFORT, "lifespan": QosTime(10, 7)}
    latched = USUAL_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL, **offered)
    offers = (USUAL_QOS._replace(depth=10), latched)
    channel = bag.add_topic(dataclasses.replace(TOPIC, offered_qos=offers))
    for number in range(200):
        time = TIME + number * 1000
        bag.write(channel, string_message(str(number)), time, time - 10)
    bag.set_custom_data("run_info", "level: tip\nseed: 1\n")
    bag.close()
    return directory


def test_definitions_hash_as_rosbags_computes() -> None:
    for type_name in RIG_TYPES:
        fresh = get_typestore(Stores.EMPTY)
        fresh.register(get_types_from_msg(full_definition(type_name), type_name))
        assert fresh.hash_rihs01(type_name) == STORE.hash_rihs01(type_name)
    with pytest.raises(UserError, match="no_such_msgs/msg/Thing is not installed"):
        full_definition("no_such_msgs/msg/Thing")


def test_rosbags_reads_messages_and_qos(texts: Path) -> None:
    with Reader(texts) as reader:
        messages = list(reader.messages())
        (connection,) = reader.connections
        assert (reader.message_count, reader.ros_distro) == (200, "jazzy")
    assert [time for _, time, _ in messages] == [TIME + n * 1000 for n in range(200)]
    assert [bytes(data) for _, _, data in messages] == [string_message(str(n)) for n in range(200)]
    assert connection.digest == STORE.hash_rihs01(TYPE)
    first, second = connection.ext.offered_qos_profiles  # type: ignore[union-attr]
    assert (first.depth, first.reliability) == (10, QosReliability.RELIABLE)
    assert second.reliability is QosReliability.BEST_EFFORT
    assert second.durability is QosDurability.TRANSIENT_LOCAL
    assert (second.lifespan.sec, second.lifespan.nsec) == (10, 7)
    assert (first.deadline.sec, first.deadline.nsec) == (9223372036, 854775807)
    text = (texts / "metadata.yaml").read_text()
    assert "&id" not in text
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["custom_data"] == {"run_info": "level: tip\nseed: 1\n"}


def test_an_existing_bag_is_not_replaced(texts: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="already contains a bag"):
        BagWriter(texts)
    (tmp_path / "parameters.yaml").write_text("{}")
    with pytest.raises(UserError, match="it is a file"):
        BagWriter(tmp_path / "parameters.yaml")
    BagWriter(tmp_path).close()
    with Reader(tmp_path) as reader:
        assert reader.message_count == 0


class _BrokenFile(io.FileIO):
    def write(self, _: object) -> int:
        raise OSError(errno.EIO, "broken")


def test_a_failing_disk_is_reported_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error precedes the run, and the next attempt can use the same folder."""
    monkeypatch.setattr(BagWriter, "open_file", lambda _, path: _BrokenFile(path, "xb"))
    with pytest.raises(UserError, match=r"cannot record into .*bag: broken"):
        open_recording(tmp_path / "bag")
    monkeypatch.undo()
    monkeypatch.setattr(FreeSpace, "usable", lambda _: -1)
    with pytest.raises(UserError, match=r"cannot record into .*bag: \d+ MB free, minimum 1 MB"):
        open_recording(tmp_path / "bag", reserve=1_000_001)
    monkeypatch.undo()
    open_recording(tmp_path / "bag").close()


def test_a_recording_ends_cleanly_before_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = open_recording(tmp_path / "bag")
    recording.add_topic(TOPIC)
    monkeypatch.setattr(FreeSpace, "usable", lambda _: -1)
    monkeypatch.setattr(recording_module, "_CHECK_EVERY", 1)
    recording.append(received())
    recording.close()
    assert str(recording.error).startswith(f"the disk of {tmp_path / 'bag'} has only")
    assert recording.is_whole
    assert read_contents(tmp_path / "bag").counts["/t"] <= 1


class HeldWorker(list[Job]):
    """Worker that runs no job before the end, like a stalled disk."""

    def __init__(self, do: RunJob, end: Job) -> None:
        self._do, self._end = do, end
        self.put = self.append

    @property
    def waiting(self) -> int:
        return len(self)

    def finish(self) -> None:
        for job in self:
            self._do(job)
        self._end()


def test_a_recording_keeps_room_for_small_messages_and_counts_dropped_ones(tmp_path: Path) -> None:
    """Images fill the available memory; commands are still recorded."""
    limit = 1_000_000
    bag, space = BagWriter(tmp_path / "bag"), FreeSpace(tmp_path, 0)
    recording = Recording(bag, space, HeldWorker, waiting_limit=limit)
    for name in ("/image", "/command"):
        recording.add_topic(dataclasses.replace(TOPIC, name=name))
    for _ in range(12):
        recording.append(Received("/image", bytes(limit // 8), TIME, TIME))
    for _ in range(50):
        recording.append(received(topic="/command"))
    assert recording.bytes_waiting < 1.2 * limit
    assert recording.dropped.keys() == {"/image"}
    # The bound on tiny messages includes their overhead in memory.
    for _ in range(1000):
        recording.append(Received("/command", b"", TIME, TIME))
    assert recording.bytes_waiting < 1.2 * limit
    dropped = dict(recording.dropped)
    assert 800 < dropped["/command"] < 1000
    recording.close()
    assert recording.is_whole
    counts = read_contents(tmp_path / "bag").counts
    assert counts == {"/image": 12 - dropped["/image"], "/command": 1050 - dropped["/command"]}


def test_health_reports_the_worst_problem() -> None:
    space = SimpleNamespace(reserve=1_000_000, usable=lambda: 10**9)
    writer: Any = SimpleNamespace(error=None, bytes_received=0, bytes_waiting=0, space=space)
    health = RecorderHealth(writer, Path("bag"))
    assert health.check(0.5, {}, []) == (Level.OK, "recording")
    assert health.check(0.5, {}, ["/odd is not recorded"]) == (Level.WARN, "/odd is not recorded")
    # At 10 MB/s, 120 s of data exceed the free space.
    for _ in range(4):
        writer.bytes_received += 5_000_000
        level, text = health.check(0.5, {}, [])
    assert level is Level.WARN
    assert text == "the disk of bag is nearly full: recording stops at 1 MB free"
    writer.bytes_waiting = WARN_WAITING + 1
    assert "slower than the graph: 50 MB wait" in health.check(0.5, {}, [])[1]
    assert health.check(0.5, {"/t": 3}, []) == (Level.WARN, "messages lost on /t")
    writer.error = "broken"
    assert health.check(0.5, {"/t": 3}, []) == (Level.ERROR, "recording ended: broken")
