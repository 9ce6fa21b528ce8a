"""Bags, of whatever recorder, damaged or made to harm: read whole, or refused in one line."""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import shutil
import sqlite3
import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import pytest
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory
from needle_core.files.bag_path import BrokenBagError, require_bag
from needle_core.files.bag_types import parsed_types

COUNT = 60
TOPICS = ("/a", "/b")
TYPE = "std_msgs/msg/UInt32"
ALL = list(range(COUNT))
MEGABYTE = 10**6


def payload(number: int) -> bytes:
    return bytes([0, 1, 0, 0]) + number.to_bytes(4, "little")


def begin(stream: Any, encoding: str = "cdr", **how: Any) -> Writer:
    """Begin an MCAP file with the two topics."""
    mcap = Writer(stream, **{"chunk_size": 300, "compression": CompressionType.NONE, **how})
    mcap.start("ros2")
    schema = mcap.register_schema(TYPE, "ros2msg", b"uint32 data\n")
    for name in TOPICS:
        mcap.register_channel(name, encoding, schema)
    return mcap


def write_mcap(file: Path, times: Callable[[int], int] = lambda n: 1000 + n, **how: Any) -> None:
    """Write an MCAP file of numbered messages."""
    with file.open("wb") as stream:
        mcap = begin(stream, **how)
        for number in range(COUNT):
            mcap.add_message(1 + number % 2, times(number), payload(number), 1, number)
        mcap.finish()  # type: ignore[no-untyped-call]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of numbered messages."""
    return rosbag(tmp_path / "bag", StoragePlugin.MCAP)


def rosbag(
    path: Path, storage: StoragePlugin, mode: CompressionMode = CompressionMode.NONE
) -> Path:
    """Write a bag of the same messages as another program's recorder does."""
    writer = BagWriter(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        connections = [writer.add_connection(name, TYPE, typestore=store) for name in TOPICS]
        for number in range(COUNT):
            writer.write(connections[number % 2], 1000 + number, payload(number))
    return path


def plain(bag: Path, **how: Any) -> Path:
    """Replace a bag's data by a file of mcap's own writer; return it."""
    (file,) = bag.glob("*.mcap")
    write_mcap(file, **how)
    return file


def change(bag: Path, **values: object) -> None:
    document = yaml.safe_load((bag / "metadata.yaml").read_text())
    document["rosbag2_bagfile_information"].update(values)
    (bag / "metadata.yaml").write_text(yaml.safe_dump(document))


def read(path: Path, topics: tuple[str, ...] = TOPICS, **when: int) -> list[int]:
    with BagDirectory(path) as bag:
        store = bag.typestore()
        found = bag.messages(topics.__contains__, **when)
        return [int(bag.deserialize(store, message).data) for message in found]


def reason(path: Path) -> str:
    """Why a bag is refused: one line, within bounds of memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(UserError) as caught:
        read(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 700 * 1024
    assert "\n" not in str(caught.value)
    return str(caught.value)


def refusal(bag: Path) -> str:
    """Why a bag is refused: what reads it and `recover` say the same, and change nothing."""
    before = {file: file.read_bytes() for file in bag.iterdir()}
    said = reason(bag)
    with pytest.raises(UserError) as caught:
        recover_bag(bag)
    assert str(caught.value) == said
    assert {file: file.read_bytes() for file in bag.iterdir()} == before
    return said


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_all_of_a_file_is_read_in_order(
    tmp_path: Path, compression: CompressionType, chunked: bool
) -> None:
    file = tmp_path / "a.mcap"
    write_mcap(file, lambda n: 1000 + (n ^ 1), compression=compression, use_chunking=chunked)
    assert read(file) == [number ^ 1 for number in range(COUNT)]
    assert read(file, ("/a",), start=1011, stop=1021) == [10, 12, 14, 16, 18]


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        *((StoragePlugin.MCAP, mode) for mode in CompressionMode),
        *((StoragePlugin.SQLITE3, mode) for mode in CompressionMode if mode.name != "STORAGE"),
    ],
)
def test_a_bag_of_another_recorder_is_read(
    tmp_path: Path, storage: StoragePlugin, mode: CompressionMode
) -> None:
    path = rosbag(tmp_path / "bag", storage, mode)
    assert read(path) == ALL
    assert read(path, ("/b",), start=1011, stop=1021) == [11, 13, 15, 17, 19]
    with BagDirectory(path) as bag:
        assert (bag.start, bag.end) == (1000, 1000 + COUNT - 1)
        assert bag.counts == dict.fromkeys(TOPICS, COUNT // 2)
    for file in path.glob("*.mcap*"):
        assert read(file) == ALL


def test_types_that_are_defined_in_idl_are_read(tmp_path: Path) -> None:
    line = "=" * 80
    text = (
        f"{line}\nIDL: rig/msg/Thing\n"
        "module rig { module msg { struct Thing { double x; rig::msg::Part part; }; }; };\n"
        f"{line}\nIDL: rig/msg/Part\n"
        "module rig { module msg { struct Part { long n; }; }; };\n"
    )
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("int32 n\n", "rig/msg/Part"))
    store.register(get_types_from_msg("float64 x\nPart part\n", "rig/msg/Thing"))
    told = store.hash_rihs01("rig/msg/Thing")
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/thing", "rig/msg/Thing", msgdef=text, rihs01=told)
        writer.write(topic, 1000, bytes([0, 1, 0, 0]) + struct.pack("<di", 1.5, 7))
    with BagDirectory(tmp_path / "bag") as bag:
        (message,) = bag.messages(lambda _: True)
        thing = bag.deserialize(bag.typestore(), message)
    assert (thing.x, thing.part.n) == (1.5, 7)


def test_a_definition_is_read_part_by_part_as_it_is_as_a_whole() -> None:
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    for name in sorted(jazzy.fielddefs)[::12]:
        text, _ = jazzy.generate_msgdef(name, ros_version=2)
        assert parsed_types("ros2msg", text, name) == get_types_from_msg(text, name)
    for after in ("int32 a\n", "MSG: \nint32 a\n", "MSG: a/B c\nint32 a\n"):
        with pytest.raises(TypesysError):
            parsed_types("ros2msg", f"int32 a\n{'=' * 80}\n{after}", "a/msg/A")


# ---- damaged, or made to harm -------------------------------------------------------------------


def test_no_flipped_bit_makes_it_less(bag: Path) -> None:
    file = plain(bag)
    whole = file.read_bytes()
    for place in range(0, len(whole), 41):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with contextlib.suppress(UserError):
            assert read(bag) == ALL, place


def test_a_chunk_whose_header_is_zero_is_not_an_empty_one(bag: Path) -> None:
    file = plain(bag)
    data = bytearray(file.read_bytes())
    place = data.index(bytes([Opcode.CHUNK]), 100) + 9
    data[place : place + 40] = bytes(40)
    file.write_bytes(data)
    assert "recover" in reason(bag)


@pytest.mark.parametrize("chunked", [True, False])
def test_an_index_that_tells_of_other_messages_is_refused(tmp_path: Path, chunked: bool) -> None:
    file = tmp_path / "a.mcap"
    with file.open("wb") as stream:
        mcap = begin(stream, use_chunking=chunked)
        for number in range(COUNT):
            mcap.add_message(1 + number % 2, 1000 + number, payload(number), 1, number)
        mcap._Writer__statistics.channel_message_counts = {1: COUNT - 1, 2: 1}  # type: ignore[attr-defined]
        mcap.finish()  # type: ignore[no-untyped-call]
    assert "its index tells of 60, or of others" in reason(file)


def test_metadata_that_tell_of_other_messages_are_refused(bag: Path) -> None:
    told = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    a, b = told["topics_with_message_count"]
    for wrong in (
        {"message_count": COUNT + 1},
        {"topics_with_message_count": [a]},
        {"topics_with_message_count": [a, {**b, "message_count": 1 + COUNT // 2}]},
        {"relative_file_paths": [*told["relative_file_paths"], "bag_1.mcap"]},
        {"version": "9"},
    ):
        change(bag, **{**told, **wrong})
        assert "recover" in reason(bag)


HARMFUL = [
    "a: &a [x, x]\n" + "".join(f"b{n}: &b{n} [*a, *a]\n" for n in range(40)),
    "[" * 100_000,
    "x: " + "y" * 17 * MEGABYTE,
    "just text",
    "\x00",
]


@pytest.mark.parametrize("text", HARMFUL, ids=["aliases", "deep", "large", "text", "zero"])
def test_metadata_made_to_harm_are_refused(bag: Path, text: str) -> None:
    (bag / "metadata.yaml").write_text(text)
    said = reason(bag)
    assert "metadata.yaml" in said
    assert ("larger than" in said) is (len(text) > 2**24)


def test_no_pipe_or_link_is_opened_and_no_file_outside_of_the_bag(
    bag: Path, tmp_path: Path
) -> None:
    for file in sorted(bag.iterdir(), reverse=True):
        elsewhere = file.rename(tmp_path / file.name)
        os.mkfifo(file)
        assert f"{file.name}: it is not a regular file" in reason(bag)
        file.unlink()
        file.symlink_to(elsewhere)
        assert f"{file.name}: it is a link" in reason(bag)
        elsewhere.replace(file)
    (file,) = bag.glob("*.mcap")
    elsewhere = file.rename(tmp_path / file.name)
    for outside in (f"../{file.name}", str(elsewhere)):
        change(bag, relative_file_paths=[outside])
        assert "No such file" in reason(bag)


@pytest.mark.parametrize(
    ("compression", "told"), [("zstd", None), ("zstd", 1000), ("lz4", 1000), ("br1", 1000)]
)
def test_a_chunk_that_would_fill_the_memory_or_cannot_be_read_is_refused(
    bag: Path, compression: str, told: int | None
) -> None:
    size = 600 * MEGABYTE
    block = bytes(size // 100)
    if compression == "lz4":
        packer = lz4.frame.LZ4FrameCompressor()
        bomb = packer.begin() + b"".join(packer.compress(block) for _ in range(100))
        bomb += packer.flush()
    else:
        bomb = b"".join([zstandard.ZstdCompressor().compress(block)] * 100)
    (file,) = bag.glob("*.mcap")
    file.write_bytes(one_chunk(bomb, compression, told or size))
    # What is kept in another way need not be broken.
    assert ("recover" in reason(bag)) is (compression != "br1")
    assert ("'br1' is not read here" in reason(bag)) is (compression == "br1")


def one_chunk(stored: bytes, compression: str, size: int) -> bytes:
    """Return a file of one chunk, by the library's own records."""
    stream = BytesIO()
    mcap = begin(stream, chunk_size=MEGABYTE)
    for number in range(COUNT):
        mcap.add_message(1 + number % 2, 1000, payload(number), 1, number)
    mcap.flush()  # type: ignore[no-untyped-call]
    builder = RecordBuilder()
    Chunk(compression, stored, 1000, 1000, 0, size).write(builder)
    (index,) = mcap._Writer__chunk_indices  # type: ignore[attr-defined]
    index.chunk_length, index.compression = builder.count, compression
    index.compressed_size, index.uncompressed_size = len(stored), size
    stream.seek(8 + struct.unpack_from("<Q", stream.getvalue(), 9)[0] + 9)
    stream.truncate()
    stream.write(builder.end())  # type: ignore[no-untyped-call]
    mcap.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def test_a_message_of_another_time_or_type_is_refused(bag: Path) -> None:
    for chunked in (True, False):
        plain(bag, times=lambda number: 2**63 + number, use_chunking=chunked)
        assert "2262" in reason(bag)
    file = plain(bag, use_chunking=False)
    first = struct.pack("<QQ", 1000, 1)
    file.write_bytes(file.read_bytes().replace(first + payload(0), first + b"\x07" * 8))
    assert "a message of /a does not fit its definition" in reason(bag)
    write_mcap(file, encoding="json")
    with pytest.raises(UserError, match="/a is not in CDR, which alone is read here"):
        read(file)


# ---- what is no bag, or kept in another way -----------------------------------------------------


def test_what_is_no_whole_bag_is_named_with_the_remedy(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "README.md").touch()
    for path, words in (
        (bag / "metadata.yaml", f"name an .mcap file or the bag's directory, {bag}"),
        (tmp_path / "README.md", "README.md is a file: name an .mcap file or the bag's directory"),
        (tmp_path / "none", "no such bag directory"),
        (tmp_path, "is not a bag: it has no metadata.yaml"),
    ):
        with pytest.raises(UserError) as caught:
            require_bag(path)
        assert str(caught.value).endswith(words)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(BrokenBagError, match=r"was not completed .*: run .*needle_bags recover"):
        require_bag(bag)
    (file,) = bag.iterdir()
    with file.open("rb") as recorder:
        fcntl.flock(recorder, fcntl.LOCK_EX)
        with pytest.raises(UserError, match="the bag is still being recorded"):
            require_bag(bag)
    for stem in ("one", "two"):
        shutil.copy(file, bag / f"{stem}.mcap")
    file.unlink()
    with pytest.raises(UserError, match=r"two recordings in one folder \(one.mcap, two.mcap\)"):
        require_bag(bag)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"compression_mode": "FILE", "compression_format": "lz4"}, "compression 'lz4'"),
        ({"compression_mode": "MESSAGE", "compression_format": "br"}, "compression 'br'"),
        ({"storage_identifier": "my_storage"}, "storage 'my_storage'"),
        ({"version": 10, "relative_file_paths": None}, "metadata.yaml is of version 10"),
        ({"version": 10, "topics_with_message_count": [{"topic": "/a"}]}, "of version 10"),
        ({"version": 10, "message_count": None, "topics_with_message_count": 3}, "version 10"),
    ],
)
def test_what_is_kept_in_another_way_is_not_broken(
    bag: Path, values: dict[str, object], words: str
) -> None:
    change(bag, version=10, something_new={"a": 1})
    assert read(bag) == ALL
    change(bag, **{"version": 9, **values})
    said = refusal(bag)
    assert words in said
    assert "recover" not in said


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_sqlite_bag_has_one_remedy(tmp_path: Path, share: float) -> None:
    bag = rosbag(tmp_path / "bag", StoragePlugin.SQLITE3)
    (file,) = bag.glob("*.db3")
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    remedy = f"mends MCAP only: `sqlite3 {file} .recover` may still read a part"
    write_mcap(bag / "stranger.mcap")
    assert refusal(bag).endswith(remedy)
    for other in ("metadata.yaml", "stranger.mcap"):
        (bag / other).unlink()
    assert refusal(bag).endswith(remedy)
    file.write_bytes(data)
    assert refusal(bag).endswith(f"run `ros2 bag reindex {bag}`")
    packed = rosbag(tmp_path / "packed", StoragePlugin.SQLITE3, CompressionMode.FILE)
    (file,) = packed.glob("*.zstd")
    file.write_bytes(file.read_bytes()[:-100])
    assert reason(packed).endswith("`recover` mends MCAP only")


@pytest.mark.parametrize("mode", ["WAL", "DELETE"])
def test_a_journal_beside_a_sqlite_bag_is_to_be_taken_in(tmp_path: Path, mode: str) -> None:
    """What the command of the message does makes the bag whole."""
    bag, killed = rosbag(tmp_path / "bag", StoragePlugin.SQLITE3), tmp_path / "killed" / "bag"
    (file,) = bag.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as database:
        database.execute(f"PRAGMA journal_mode={mode}")
        database.execute("PRAGMA cache_size=1")
        database.execute("BEGIN")
        database.execute("DELETE FROM messages WHERE id > 50")
        # More than its cache holds: what was deleted is gone from the file, too.
        database.execute("CREATE TABLE filler AS SELECT zeroblob(1000000)")
        if mode == "WAL":
            database.execute("COMMIT")
        shutil.copytree(bag, killed)
    if mode == "WAL":
        # All that metadata.yaml tells of is in the file: the bag is as it was.
        assert read(killed) == ALL
        (killed / "metadata.yaml").unlink()
    journal = killed / f"{file.name}-{'wal' if mode == 'WAL' else 'journal'}"
    said = refusal(killed)
    assert f"SQLite has not taken in {journal.name} yet: run `sqlite3 " in said
    program, name, statement = said.partition("run `")[2].rstrip("`").split(" ", 2)
    assert (program, Path(name)) == ("sqlite3", killed / file.name)
    with contextlib.closing(sqlite3.connect(name)) as mended:
        mended.execute(statement.strip("'"))
    assert not journal.exists()
    if mode == "DELETE":
        assert read(killed) == ALL
    else:
        assert "ros2 bag reindex" in refusal(killed)
