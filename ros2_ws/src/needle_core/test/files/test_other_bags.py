"""Bags of other recorders: read, or refused in one line that is right for every tool."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from pathlib import Path

import pytest
import yaml
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from needle_bags.recovery import recover
from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory

COUNT = 3000
TYPE = "std_msgs/msg/UInt32"


def write(
    path: Path,
    storage: StoragePlugin = StoragePlugin.MCAP,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A bag of numbered messages, as rosbags writes it."""
    writer = BagWriter(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/a", TYPE, typestore=get_typestore(Stores.ROS2_JAZZY))
        for number in range(COUNT):
            data = bytes([0, 1, 0, 0]) + number.to_bytes(4, "little")
            writer.write(topic, 1000 + number, data)
    return path


def change(path: Path, **values: object) -> None:
    document = yaml.safe_load((path / "metadata.yaml").read_text())
    document["rosbag2_bagfile_information"].update(values)
    (path / "metadata.yaml").write_text(yaml.safe_dump(document))


def read(path: Path) -> list[int]:
    with BagDirectory(path) as bag:
        store = bag.typestore()
        return [bag.deserialize(store, m).data for m in bag.messages(lambda _: True)]


def reason(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Why a bag is refused: what reads it and `recover` say the same, and change nothing."""
    before = {file: file.read_bytes() for file in path.iterdir()}
    with pytest.raises(UserError) as caught:
        read(path)
    assert recover.main([str(path)]) == 2
    assert capsys.readouterr().err == f"error: {caught.value}\n"
    assert {file: file.read_bytes() for file in path.iterdir()} == before
    return str(caught.value)


def test_newer_metadata_are_read_where_they_say_what_the_older_say(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    change(path, version=10, something_new={"a": 1})
    before = (path / "metadata.yaml").read_bytes()
    assert read(path) == list(range(COUNT))
    assert recover.main([str(path)]) == 0
    assert (path / "metadata.yaml").read_bytes() == before


@pytest.mark.parametrize(
    "values",
    [
        {"relative_file_paths": None},
        {"topics_with_message_count": [{"topic": "/a"}]},
        {"relative_file_paths": [{"path": "bag.mcap"}], "files": 5},
        {"message_count": None, "topics_with_message_count": 3},
    ],
)
def test_newer_metadata_that_are_not_understood_are_not_broken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], values: dict[str, object]
) -> None:
    path = write(tmp_path / "bag")
    change(path, version=10, **values)
    said = reason(path, capsys)
    assert "metadata.yaml is of version 10" in said
    assert "recover" not in said


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"compression_mode": "FILE", "compression_format": "lz4"}, "compression 'lz4'"),
        ({"compression_mode": "MESSAGE", "compression_format": "br"}, "compression 'br'"),
        ({"storage_identifier": "my_storage"}, "storage 'my_storage'"),
    ],
)
def test_what_is_kept_in_another_way_is_not_broken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], values: dict[str, object], words: str
) -> None:
    path = write(tmp_path / "bag")
    change(path, **values)
    said = reason(path, capsys)
    assert f"{words} is not read here" in said
    assert "broken" not in said


def write_mcap(file: Path, compression: CompressionType, encoding: str = "cdr") -> None:
    with file.open("wb") as stream:
        mcap = Writer(stream, compression=compression)
        mcap.start("ros2")
        schema = mcap.register_schema(TYPE, "ros2msg", b"uint32 data\n")
        channel = mcap.register_channel("/a", encoding, schema)
        for number in range(COUNT):
            data = bytes([0, 1, 0, 0]) + number.to_bytes(4, "little")
            mcap.add_message(channel, 1000 + number, data, 1)
        mcap.finish()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_file_alone_is_read(tmp_path: Path, compression: CompressionType) -> None:
    write_mcap(tmp_path / "a.mcap", compression)
    write_mcap(tmp_path / "b.mcap", compression)
    assert read(tmp_path / "a.mcap") == list(range(COUNT))


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_compressed_file_alone_is_read(tmp_path: Path, mode: CompressionMode) -> None:
    path = write(tmp_path / "bag", mode=mode)
    (file,) = path.glob("*.mcap*")
    assert read(file) == list(range(COUNT))


def test_chunks_that_are_compressed_in_another_way_are_not_broken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    file = bag / "bag_0.mcap"
    write_mcap(file, CompressionType.LZ4)
    data = bytearray(file.read_bytes().replace(b"\x03\0\0\0lz4", b"\x03\0\0\0br1"))
    data[-12:-8] = bytes(4)  # the checksum of the index
    file.write_bytes(data)
    with pytest.raises(UserError, match=r"bag_0\.mcap: its compression 'br1' is not read here"):
        read(file)
    assert recover.main([str(bag)]) == 2
    said = capsys.readouterr().err
    assert "'br1' is not read here" in said
    assert "broken" not in said


def test_what_is_no_ros_2_message_is_not_broken(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", CompressionType.ZSTD, "json")
    with pytest.raises(UserError, match="/a is not in CDR, which alone is read here"):
        read(tmp_path / "a.mcap")


def sqlite(path: Path) -> Path:
    """Write a bag; return its only file."""
    (file,) = write(path, StoragePlugin.SQLITE3).glob("*.db3")
    return file


def test_a_whole_sqlite_bag_is_left_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = sqlite(tmp_path / "bag")
    before = file.read_bytes()
    assert read(tmp_path / "bag") == list(range(COUNT))
    assert recover.main([str(tmp_path / "bag")]) == 0
    assert f"is whole: {COUNT} messages of 1 topics" in capsys.readouterr().out
    assert file.read_bytes() == before


@pytest.mark.parametrize("has_metadata", [True, False])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.5, 0.99])
def test_a_truncated_sqlite_bag_has_one_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], share: float, has_metadata: bool
) -> None:
    file = sqlite(tmp_path / "bag")
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    if has_metadata:
        write_mcap(tmp_path / "bag" / "stranger.mcap", CompressionType.NONE)
    else:
        (tmp_path / "bag" / "metadata.yaml").unlink()
    said = reason(tmp_path / "bag", capsys)
    assert f"{file.name} is damaged, and `recover` mends MCAP only" in said
    assert said.endswith(f"`sqlite3 {file} .recover` may still read a part")
    assert "reindex" not in said


def test_a_truncated_sqlite_bag_that_was_compressed_as_a_whole_has_no_remedy(
    tmp_path: Path,
) -> None:
    bag = write(tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.FILE)
    (file,) = bag.glob("*.zstd")
    file.write_bytes(file.read_bytes()[:-100])
    for act in (read, recover_bag):
        with pytest.raises(UserError, match=r"`recover` mends MCAP only$"):
            act(bag)


def test_a_sqlite_bag_without_metadata_is_to_be_indexed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sqlite(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert reason(tmp_path / "bag", capsys).endswith(f"run `ros2 bag reindex {tmp_path}/bag`")


@pytest.mark.parametrize("mode", ["WAL", "DELETE"])
@pytest.mark.parametrize("has_metadata", [True, False])
def test_a_journal_beside_a_sqlite_bag_is_to_be_taken_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: str, has_metadata: bool
) -> None:
    """What the command of the message does makes the bag whole."""
    file = sqlite(tmp_path / "bag")
    database = sqlite3.connect(file, isolation_level=None)
    database.execute(f"PRAGMA journal_mode={mode}")
    database.execute("PRAGMA cache_size=1")
    database.execute("BEGIN")
    database.execute("UPDATE messages SET timestamp = timestamp + 5")
    database.execute("DELETE FROM messages WHERE id > 2000")
    if mode == "WAL":
        database.execute("COMMIT")
    killed = tmp_path / "killed" / "bag"
    shutil.copytree(tmp_path / "bag", killed)
    database.close()
    if not has_metadata:
        (killed / "metadata.yaml").unlink()
    journal = f"{file.name}-{'wal' if mode == 'WAL' else 'journal'}"
    if mode == "WAL" and has_metadata:
        # All that metadata.yaml tells of is in the file: the bag is as it was.
        assert read(killed) == list(range(COUNT))
        return
    said = reason(killed, capsys)
    assert f"SQLite has not taken in {journal} yet: run `sqlite3 " in said
    command = said.partition("run `")[2].rstrip("`")
    program, name, statement, *_ = [part.strip() for part in command.replace("'", "").split(" ", 2)]
    assert (program, Path(name)) == ("sqlite3", killed / file.name)
    with contextlib.closing(sqlite3.connect(name)) as mended:
        mended.execute(statement)
    if has_metadata:
        assert read(killed) == list(range(COUNT))
    else:
        assert "ros2 bag reindex" in reason(killed, capsys)
    assert not (killed / journal).exists()
