from __future__ import annotations

import fcntl
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    Reader,
    StoragePlugin,
)
from rosbags.rosbag2 import Writer as OtherWriter

from needle_analysis.report import report
from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter
from needle_bags.reading.bag_files import raw_messages, read_contents
from needle_bags.reading.bag_reader import read_run
from needle_bags.recovery import recover
from needle_bags.recovery.bag_recovery import recover_bag
from needle_common.errors import UserError
from needle_common.files.bag_data import unpack_file
from needle_common.files.bag_directory import BagDirectory
from needle_common.files.bag_topic import BagTopic

MakeRun = Callable[..., Path]
TYPE = "std_msgs/msg/String"
DEFINITION = "string data\n"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
LATCHED = USUAL_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL)


def write(path: Path, count: int = 300, **how: int | str) -> Path:
    bag = BagWriter(path, chunk_size=2048, **how)  # type: ignore[arg-type]
    topics = [
        bag.add_topic(BagTopic(name, TYPE, DEFINITION, HASH, (LATCHED,))) for name in ("/a", "/b")
    ]
    bag.add_metadata("needle_run", {"commit": "0123abc", "run_info": "seed: 3"})
    for node, gain in (("/one", 1.5), ("/two", 2.5)):
        text = yaml.safe_dump({node: {"ros__parameters": {"gain": gain}}})
        bag.add_metadata("parameters", {"node": node, "yaml": text})
    bag.add_metadata("parameter_change", {"stamp_ns": "5", "node": "/one", "value": "2.0"})
    for number in range(count):
        bag.write(topics[number % 2], bytes([0, 1, 0, 0]) + bytes(60), 1000 + number, 1000)
    bag.close()
    return path


def numbers_kept(path: Path) -> int:
    with Reader(path) as reader:
        assert reader.message_count == sum(1 for _ in reader.messages())
        return reader.message_count


def kill(path: Path) -> Path:
    """Leave what a killed recorder leaves: no metadata.yaml, no index, half a chunk."""
    (path / "metadata.yaml").unlink()
    file = max(path.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 3 // 4])
    return path


def test_a_killed_recording_becomes_a_bag_again(tmp_path: Path) -> None:
    path = kill(write(tmp_path / "bag"))
    recovery = recover_bag(path)
    assert not recovery.was_whole
    assert numbers_kept(path) == recovery.messages > 150
    contents = read_contents(path)
    assert contents.custom_data["commit"] == "0123abc"
    assert contents.custom_data["run_info"] == "seed: 3"
    parameters = yaml.safe_load(contents.custom_data["parameters"])
    assert parameters["/two"]["ros__parameters"]["gain"] == 2.5
    (change,) = yaml.safe_load(contents.custom_data["parameter_changes"])
    assert (change["stamp_ns"], change["value"]) == (5, 2.0)
    assert contents.custom_data["recovered"]
    assert contents.distribution == "jazzy"
    assert contents.topics["/a"].type_hash == HASH
    with Reader(path) as reader:
        (offered,) = reader.connections[0].ext.offered_qos_profiles  # type: ignore[union-attr]
        assert offered.durability is QosDurability.TRANSIENT_LOCAL


def test_without_metadata_alone_everything_comes_back(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    before = yaml.safe_load((path / "metadata.yaml").read_text())
    (path / "metadata.yaml").unlink()
    recovery = recover_bag(path)
    assert (recovery.messages, recovery.bytes_lost) == (300, 0)
    after = yaml.safe_load((path / "metadata.yaml").read_text())
    for document in (before, after):
        del document["rosbag2_bagfile_information"]["custom_data"]
    assert after == before


@pytest.mark.parametrize("text", ["rosbag2_bagfile_information: [1, {", "[]", ""])
def test_broken_metadata_are_made_anew(tmp_path: Path, text: str) -> None:
    path = write(tmp_path / "bag")
    (path / "metadata.yaml").write_text(text)
    assert recover_bag(path).messages == 300
    assert numbers_kept(path) == 300


def test_of_several_files_the_last_is_mended(tmp_path: Path) -> None:
    path = kill(write(tmp_path / "bag", count=2000, max_file_size=40_000))
    files = sorted(path.glob("*.mcap"))
    assert len(files) >= 3
    recovery = recover_bag(path)
    assert recovery.kept == [f"{files[-1].name}.damaged"]
    assert numbers_kept(path) == recovery.messages
    times = [time for _, time, _ in raw_messages(path, {"/a", "/b"}, 0, 2**62)]
    assert times == list(range(1000, 1000 + len(times)))


def test_ten_files_are_in_order(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", count=1000, max_file_size=5_000)
    (path / "metadata.yaml").unlink()
    recovery = recover_bag(path)
    assert list(recovery.files)[9:11] == ["bag_9.mcap", "bag_10.mcap"]
    assert numbers_kept(path) == 1000


def test_nothing_is_done_to_a_whole_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "bag")
    before = {file: file.read_bytes() for file in path.iterdir()}
    assert recover.main([str(path)]) == 0
    assert "is whole: 300 messages of 2 topics; nothing to do" in capsys.readouterr().out
    assert {file: file.read_bytes() for file in path.iterdir()} == before


def test_the_command_says_what_was_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = kill(write(tmp_path / "bag"))
    assert recover.main([str(path), "--json", str(tmp_path / "out.json")]) == 0
    said = capsys.readouterr().out
    values = json.loads((tmp_path / "out.json").read_text())
    assert f"recovered {path}: {values['messages']} messages of 2 topics" in said
    assert f"lost: bag_0.mcap: {values['lost_bytes']} bytes could not be read" in said


def test_a_bag_that_is_being_recorded_is_left_alone(tmp_path: Path) -> None:
    path = kill(write(tmp_path / "bag"))
    with (path / "bag_0.mcap").open("r+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        for act in (recover_bag, read_run):
            with pytest.raises(UserError, match="still being recorded"):
                act(path)
    recover_bag(path)


def write_compressed(path: Path, mode: CompressionMode) -> Path:
    """A bag of 300 messages as another recorder compresses it."""
    writer = OtherWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/a", TYPE, msgdef=DEFINITION, rihs01=HASH)
        for number in range(300):
            text = f"message {number}".encode()
            data = bytes([0, 1, 0, 0]) + (len(text) + 1).to_bytes(4, "little") + text + b"\0"
            writer.write(topic, 1000 + number, data)
    return path


def texts(path: Path) -> list[str]:
    with BagDirectory(path) as bag:
        store = bag.typestore()
        return [str(bag.deserialize(store, m).data) for m in bag.messages(lambda _: True)]


def test_messages_that_were_compressed_one_by_one_come_back(tmp_path: Path) -> None:
    path = write_compressed(tmp_path / "bag", CompressionMode.MESSAGE)
    assert recover_bag(path).was_whole
    (path / "metadata.yaml").unlink()
    assert recover_bag(path).kept == []
    assert texts(path) == [f"message {number}" for number in range(300)]
    assert numbers_kept(path) == 300
    recovery = recover_bag(kill(path))
    found = texts(path)
    assert len(found) == recovery.messages > 150
    assert found == [f"message {number}" for number in range(len(found))]


def test_files_that_were_compressed_as_a_whole_are_to_be_unpacked_first(tmp_path: Path) -> None:
    path = write_compressed(tmp_path / "bag", CompressionMode.FILE)
    with pytest.raises(UserError, match=r"run `unzstd --rm .*/bag/\*\.mcap\.zstd`"):
        recover_bag(path)
    (packed,) = path.glob("*.zstd")
    unpack_file(packed, path)
    packed.unlink()
    assert recover_bag(path).losses.lines() == []
    assert len(texts(path)) == 300


def sqlite(path: Path) -> None:
    path.mkdir()
    (path / "bag_0.db3").write_bytes(b"SQLite format 3")


def no_mcap(path: Path) -> None:
    path.mkdir()
    (path / "bag_0.mcap").write_bytes(b"something else")


def empty(path: Path) -> None:
    path.mkdir()


def nothing(_: Path) -> None:
    return


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (sqlite, "ros2 bag reindex"),
        (no_mcap, "bag_0.mcap: it does not begin as an MCAP file"),
        (empty, "has no .mcap file"),
        (nothing, "no such bag directory"),
    ],
)
def test_what_cannot_be_recovered_is_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    make: Callable[[Path], None],
    words: str,
) -> None:
    make(tmp_path / "bag")
    assert recover.main([str(tmp_path / "bag")]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_who_opens_a_broken_bag_is_told_the_command(
    tmp_path: Path, make_run: MakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_run()
    command = f"run `ros2 run needle_bags recover {path}`"
    whole = (path / "metadata.yaml").read_bytes()
    (path / "metadata.yaml").unlink()
    with pytest.raises(UserError) as caught:
        read_run(path)
    assert str(caught.value).endswith(command)
    (path / "metadata.yaml").write_bytes(whole)
    data = path / "run_0.mcap"
    data.write_bytes(data.read_bytes()[:-20])
    assert report.main([str(path)]) == 2
    said = capsys.readouterr().err
    assert command in said
    assert said.count("\n") == 1
    recover.main([str(path)])
    assert len(read_run(path).tips) == 121


def test_a_file_instead_of_a_bag(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    for act in (recover_bag, read_contents):
        with pytest.raises(UserError, match="name the bag's directory"):
            act(path / "bag_0.mcap")


def test_a_topic_of_another_type_is_named(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag")
    for name in ("/needle/controller_status", "/needle/tip"):
        topic = bag.add_topic(BagTopic(name, TYPE, DEFINITION, HASH))
        bag.write(topic, bytes(8), 1, 1)
    bag.close()
    with pytest.raises(UserError, match="/needle/tip has type std_msgs/msg/String, the rig's has"):
        read_run(tmp_path / "bag")


def test_definitions_of_another_distribution_are_named(tmp_path: Path) -> None:
    """A PointStamped without `point`: by its own definition it can be read, as a tip it cannot."""
    bag = BagWriter(tmp_path / "bag", distribution="humble")
    kinds = (
        ("/needle/controller_status", "diagnostic_msgs/msg/DiagnosticStatus"),
        ("/needle/tip", "geometry_msgs/msg/PointStamped"),
    )
    for name, type_name in kinds:
        topic = bag.add_topic(BagTopic(name, type_name, "float64 old\n"))
        bag.write(topic, bytes([0, 1, 0, 0]) + bytes(8), 1, 1)
    bag.close()
    with pytest.raises(UserError, match=r"as Jazzy has it \(bag of humble") as caught:
        read_run(tmp_path / "bag")
    assert "\n" not in str(caught.value)
