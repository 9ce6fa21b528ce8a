"""Bags that are damaged or made to harm: one line, and never less than was recorded."""

from __future__ import annotations

import os
import resource
import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, Message
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory
from needle_core.files.bag_path import require_bag
from needle_core.files.bag_types import parsed_types

COUNT = 60
TOPICS = ("/a", "/b")
TYPE = "std_msgs/msg/UInt32"
MEGABYTE = 10**6


def payload(number: int) -> bytes:
    return bytes([0, 1, 0, 0]) + number.to_bytes(4, "little")


def write(
    path: Path, times: Callable[[int], int] = lambda n: 1000 + n, **how: object
) -> dict[str, object]:
    """A bag of numbered messages; returns metadata.yaml's content."""
    path.mkdir()
    options = {"chunk_size": 300, "compression": CompressionType.NONE, **how}
    with (path / "bag_0.mcap").open("wb") as stream:
        mcap = Writer(stream, **options)  # type: ignore[arg-type]
        mcap.start("ros2")
        schema = mcap.register_schema(TYPE, "ros2msg", b"uint32 data\n")
        channels = [mcap.register_channel(name, "cdr", schema) for name in TOPICS]
        for number in range(COUNT):
            mcap.add_message(channels[number % 2], times(number), payload(number), 1, number)
        mcap.finish()  # type: ignore[no-untyped-call]
    information: dict[str, object] = {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": ["bag_0.mcap"],
        "message_count": COUNT,
        "topics_with_message_count": [
            {"topic_metadata": {"name": name, "type": TYPE}, "message_count": COUNT // 2}
            for name in TOPICS
        ],
    }
    save(path, information)
    return information


def save(path: Path, information: object) -> None:
    text = yaml.safe_dump({"rosbag2_bagfile_information": information})
    (path / "metadata.yaml").write_text(text)


def read(path: Path, topics: tuple[str, ...] = TOPICS, **when: int) -> list[int]:
    with BagDirectory(path) as bag:
        store = bag.typestore()
        found = bag.messages(topics.__contains__, **when)
        return [int(bag.deserialize(store, message).data) for message in found]


def reason(path: Path, topics: tuple[str, ...] = TOPICS) -> str:
    """Why a bag is refused: one line, within bounds of memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(UserError) as caught:
        read(path, topics)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 700 * 1024
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_all_is_read_in_order(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    def swapped(number: int) -> int:
        return 1000 + (number ^ 1)

    write(tmp_path / "bag", swapped, compression=compression, use_chunking=chunked)
    assert read(tmp_path / "bag") == [number ^ 1 for number in range(COUNT)]
    assert read(tmp_path / "bag", ("/a",), start=1010, stop=1020) == [10, 12, 14, 16, 18]


def write_elsewhere(path: Path, storage: StoragePlugin, mode: CompressionMode) -> None:
    """The same messages as another program's bag."""
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = BagWriter(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = [writer.add_connection(name, TYPE, typestore=store) for name in TOPICS]
        for number in range(COUNT):
            writer.write(connections[number % 2], 1000 + number, payload(number))


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
    path = tmp_path / "bag"
    write_elsewhere(path, storage, mode)
    assert read(path) == list(range(COUNT))
    assert read(path, ("/b",), start=1010, stop=1020) == [11, 13, 15, 17, 19]
    with BagDirectory(path) as bag:
        assert (bag.start, bag.end) == (1000, 1000 + COUNT - 1)
        assert bag.counts == dict.fromkeys(TOPICS, COUNT // 2)


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
    for name in jazzy.fielddefs:
        text, _ = jazzy.generate_msgdef(name, ros_version=2)
        assert parsed_types("ros2msg", text, name) == get_types_from_msg(text, name)


@pytest.mark.parametrize("after", ["int32 a\n", "MSG: \nint32 a\n", "MSG: a/B c\nint32 a\n"])
def test_a_part_that_is_no_type_is_refused(after: str) -> None:
    with pytest.raises(TypesysError):
        parsed_types("ros2msg", f"int32 a\n{'=' * 80}\n{after}", "a/msg/A")


def test_no_flipped_bit_makes_it_less(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    whole = file.read_bytes()
    for place in range(0, len(whole), 7):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        try:
            assert read(tmp_path / "bag") == list(range(COUNT)), place
        except UserError as error:
            assert "\n" not in str(error)


def test_a_chunk_whose_header_is_zero_is_not_an_empty_one(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    data = bytearray(file.read_bytes())
    place = data.index(struct.pack("<BQ", Opcode.CHUNK, 0)[:1], 100) + 9
    data[place : place + 40] = bytes(40)
    file.write_bytes(data)
    assert "recover" in reason(tmp_path / "bag")


@pytest.mark.parametrize("change", ["count", "topic", "missing file", "type"])
def test_metadata_that_tell_of_other_messages_are_refused(tmp_path: Path, change: str) -> None:
    information = write(tmp_path / "bag")
    topics: list[dict[str, object]] = information["topics_with_message_count"]  # type: ignore[assignment]
    if change == "count":
        information["message_count"] = COUNT - 1
    elif change == "topic":
        topics[0]["message_count"], topics[1]["message_count"] = 29, 31
    elif change == "missing file":
        information["relative_file_paths"] = ["bag_0.mcap", "bag_1.mcap"]
    else:
        information["version"] = "9"
    save(tmp_path / "bag", information)
    assert "recover" in reason(tmp_path / "bag")


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x, x]\n" + "".join(f"b{n}: &b{n} [*a, *a]\n" for n in range(40)),
        "[" * 100_000,
        "- " * 100_000,
        "x: " + "y" * 17 * MEGABYTE,
        "just text",
        "\x00",
    ],
)
def test_metadata_made_to_harm_are_refused(tmp_path: Path, text: str) -> None:
    write(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    assert "metadata.yaml" in reason(tmp_path / "bag")


@pytest.mark.parametrize("name", ["metadata.yaml", "bag_0.mcap"])
def test_pipes_and_links_are_not_opened(tmp_path: Path, name: str) -> None:
    write(tmp_path / "bag")
    file, elsewhere = tmp_path / "bag" / name, tmp_path / "elsewhere"
    file.rename(elsewhere)
    os.mkfifo(file)
    assert f"{name}: it is not a regular file" in reason(tmp_path / "bag")
    file.unlink()
    file.symlink_to(elsewhere)
    assert f"{name}: it is a link" in reason(tmp_path / "bag")


def test_files_outside_of_the_bag_are_not_read(tmp_path: Path) -> None:
    information = write(tmp_path / "bag")
    (tmp_path / "bag" / "bag_0.mcap").rename(tmp_path / "bag_0.mcap")
    for outside in ("../bag_0.mcap", str(tmp_path / "bag_0.mcap")):
        information["relative_file_paths"] = [outside]
        save(tmp_path / "bag", information)
        assert "No such file" in reason(tmp_path / "bag")


@pytest.mark.parametrize("told", ["the truth", "less"])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_would_fill_the_memory_is_refused(
    tmp_path: Path, compression: str, told: str
) -> None:
    size = 1500 * MEGABYTE
    block = bytes(size // 100)
    if compression == "zstd":
        bomb = b"".join([zstandard.ZstdCompressor().compress(block)] * 100)
    else:
        packer = lz4.frame.LZ4FrameCompressor()
        bomb = packer.begin() + b"".join(packer.compress(block) for _ in range(100))
        bomb += packer.flush()
    path = tmp_path / "bag"
    write(path, use_chunking=False)
    replace_data(path / "bag_0.mcap", bomb, compression, size if told == "the truth" else 1000)
    assert "recover" in reason(path)


def replace_data(file: Path, stored: bytes, compression: str, size: int) -> None:
    """Write a file of one chunk, by the library's own records."""
    stream = BytesIO()
    mcap = Writer(stream, compression=CompressionType.NONE)
    mcap.start("ros2")
    schema = mcap.register_schema(TYPE, "ros2msg", b"uint32 data\n")
    for name in TOPICS:
        mcap.register_channel(name, "cdr", schema)
    for number in range(COUNT):
        mcap.add_message(1 + number % 2, 1000, payload(number), 1, number)
    mcap.flush()  # type: ignore[no-untyped-call]
    builder = RecordBuilder()
    Chunk(compression, stored, 1000, 1000, 0, size).write(builder)
    begin = 8 + struct.unpack_from("<Q", stream.getvalue(), 9)[0] + 9
    (index,) = mcap._Writer__chunk_indices  # type: ignore[attr-defined]
    index.chunk_length, index.compression = builder.count, compression
    index.compressed_size, index.uncompressed_size = len(stored), size
    stream.seek(begin)
    stream.truncate()
    stream.write(builder.end())  # type: ignore[no-untyped-call]
    mcap.finish()  # type: ignore[no-untyped-call]
    file.write_bytes(stream.getvalue())


@pytest.mark.parametrize("chunked", [True, False])
def test_times_beyond_those_of_ros_are_refused(tmp_path: Path, chunked: bool) -> None:
    write(tmp_path / "bag", lambda number: 2**63 + number, use_chunking=chunked)
    assert "2262" in reason(tmp_path / "bag")


def test_a_message_of_another_type_is_one_line(tmp_path: Path) -> None:
    write(tmp_path / "bag", use_chunking=False)
    file = tmp_path / "bag" / "bag_0.mcap"
    data = file.read_bytes()
    builder = RecordBuilder()
    Message(1, 1000, payload(0), 1, 0).write(builder)
    record = builder.end()  # type: ignore[no-untyped-call]
    file.write_bytes(data.replace(record, record[:-8] + b"\x07" * 8))
    assert "a message of /a does not fit its definition" in reason(tmp_path / "bag")


def test_metadata_alone_name_the_bag(tmp_path: Path) -> None:
    write(tmp_path / "bag")
    with pytest.raises(UserError, match=f"or the bag's directory, {tmp_path}/bag$"):
        require_bag(tmp_path / "bag" / "metadata.yaml")


def test_another_file_is_no_bag_and_names_none(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("")
    with pytest.raises(UserError, match=r"README\.md is a file: name an \.mcap file or the bag's"):
        require_bag(tmp_path / "README.md")
