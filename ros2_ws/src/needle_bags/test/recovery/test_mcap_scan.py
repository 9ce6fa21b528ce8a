"""Files cut and damaged; the readers of rosbags and mcap are the oracles."""

from __future__ import annotations

import resource
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from needle_bags.format.bag_metadata import (
    DataFile,
    bag_information,
    channel_metadata,
    write_metadata,
)
from needle_bags.format.bag_writer import BagWriteError, BagWriter
from needle_bags.format.mcap_ending import McapEnding
from needle_bags.recovery.bag_recovery import BagRecovery, recover_bag
from needle_common.errors import UserError
from needle_common.files.bag_directory import BagDirectory
from needle_common.files.bag_topic import BagTopic

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPE = "std_msgs/msg/UInt8MultiArray"
DEFINITION, HASH = STORE.generate_msgdef(TYPE, ros_version=2)[0], STORE.hash_rihs01(TYPE)
TOPICS = ("/one", "/two", "/three")
LENGTH = 100
COUNT = 600


def payload(number: int) -> bytes:
    """A message that tells its number and ends in no zero, as a power cut's zeros do."""
    content = np.frombuffer(np.random.default_rng(number).bytes(LENGTH) + b"\x01", np.uint8)
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=number)
    return bytes(STORE.serialize_cdr(STORE.types[TYPE](layout=layout, data=content), TYPE))


def number_of(data: bytes) -> int:
    return int(STORE.deserialize_cdr(data, TYPE).layout.data_offset)  # type: ignore[attr-defined]


def write(directory: Path, *, compression: str = "none", whole: bool = False) -> Path:
    """A bag of one file of many chunks, whole or as a killed recorder leaves it."""
    bag = BagWriter(directory, chunk_size=4096, compression=compression)
    topics = [bag.add_topic(BagTopic(name, TYPE, DEFINITION, HASH)) for name in TOPICS]
    bag.add_metadata("needle_run", {"commit": "0123abc"})
    for number in range(COUNT):
        bag.write(topics[number % 3], payload(number), 1000 + number, 1000, number // 3 + 1)
        if number == COUNT // 2:
            bag.add_attachment("calibration.yaml", "application/yaml", b"left: {}\n", 1)
    bag.flush()
    killed = bag.data_file.read_bytes()
    bag.close()
    if not whole:
        bag.data_file.write_bytes(killed)
        (directory / "metadata.yaml").unlink()
    return bag.data_file


def write_unchunked(directory: Path) -> Path:
    """A bag as rosbag2's recorder writes it with config/rosbag2_mcap.yaml."""
    directory.mkdir()
    content = DataFile(f"{directory.name}_0.mcap")
    topics = [BagTopic(name, TYPE, DEFINITION, HASH) for name in TOPICS]
    with (directory / content.name).open("wb") as stream:
        mcap = Writer(stream, use_chunking=False)
        mcap.start("ros2")
        schema = mcap.register_schema(TYPE, "ros2msg", DEFINITION.encode())
        channels = [
            mcap.register_channel(t.name, "cdr", schema, channel_metadata(t)) for t in topics
        ]
        for number in range(COUNT):
            mcap.add_message(channels[number % 3], 1000 + number, payload(number), 1000)
            content.add(TOPICS[number % 3], 1000 + number)
        mcap.finish()  # type: ignore[no-untyped-call]
    write_metadata(directory, bag_information([content], topics, {}, "jazzy"))
    return directory / content.name


def recover(file: Path) -> BagRecovery:
    """Recover the file's bag; what was there is still there."""
    before = file.read_bytes()
    recovery = recover_bag(file.parent)
    kept = [path.read_bytes() for path in file.parent.glob("*.mcap*")]
    assert before in kept
    assert not [path for path in file.parent.iterdir() if path.name.startswith(".")]
    return recovery


def numbers(file: Path) -> list[int]:
    """The messages' numbers as all three readers see them."""
    with file.open("rb") as stream:
        indexed = [m.data for _, _, m in make_reader(stream, validate_crcs=True).iter_messages()]
    with file.open("rb") as stream:
        records = StreamReader(stream, validate_crcs=True).records
        streamed = [record.data for record in records if isinstance(record, Message)]
    with Reader(file) as reader:
        by_rosbags = [bytes(data) for _, _, data in reader.messages()]
    assert sorted(indexed) == sorted(streamed) == sorted(by_rosbags)
    found = sorted(number_of(data) for data in by_rosbags)
    assert sorted(by_rosbags) == sorted(payload(number) for number in found)
    require_indexes_in_place(file)
    return found


def require_indexes_in_place(file: Path) -> None:
    """The C++ readers go by the offsets of message indexes, the Python ones do not."""
    data = file.read_bytes()
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        assert chunk.message_index_offsets
        for channel, offset in chunk.message_index_offsets.items():
            opcode, _, found = struct.unpack_from("<BQH", data, offset)
            assert (opcode, found) == (Opcode.MESSAGE_INDEX, channel)


@pytest.fixture(scope="module")
def file_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write(tmp_path_factory.mktemp("unfinished") / "bag").read_bytes()


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(20, len(data))]


def cut_and_zeros(data: bytes, rng: np.random.Generator) -> bytes:
    return cut(data, rng) + bytes(rng.integers(1, 5000))


@pytest.mark.parametrize("damage", [cut, cut_and_zeros])
def test_a_file_cut_anywhere_keeps_every_whole_message(
    tmp_path: Path, file_bytes: bytes, damage: Callable[[bytes, np.random.Generator], bytes]
) -> None:
    rng = np.random.default_rng(5)
    for trial in range(25):
        file = tmp_path / str(trial) / "bag_0.mcap"
        file.parent.mkdir()
        data = damage(file_bytes, rng)
        file.write_bytes(data)
        recovery = recover(file)
        kept = numbers(file)
        assert len(kept) == recovery.messages
        there = sum(payload(number) in data for number in range(COUNT))
        assert kept == list(range(there))


@pytest.mark.parametrize("bit", [0, 1, 2, 6, 7, 8, 15, 24, 30, 63])
def test_a_wrong_length_costs_no_other_message(tmp_path: Path, bit: int) -> None:
    """Without chunks all that tells where a message ends is the length before it."""
    file = write_unchunked(tmp_path / "bag")
    data = bytearray(file.read_bytes())
    place = data.index(payload(100)) - 30
    data[place + bit // 8] ^= 1 << bit % 8
    file.write_bytes(data)
    with pytest.raises(UserError, match="recover"):
        read(file)
    recovery = recover(file)
    missing = set(range(COUNT)) - set(numbers(file))
    assert missing <= {100}
    assert recovery.losses.messages == ({"/two": 1} if missing else {})
    assert read(file) == numbers(file)


@pytest.mark.parametrize("bit", [0, 7, 8, 40, 63])
@pytest.mark.parametrize("kind", ["chunked", "unchunked"])
def test_a_wrong_length_of_the_header_costs_nothing(tmp_path: Path, kind: str, bit: int) -> None:
    path = tmp_path / "bag"
    file = write(path, whole=True) if kind == "chunked" else write_unchunked(path)
    data = bytearray(file.read_bytes())
    data[9 + bit // 8] ^= 1 << bit % 8
    file.write_bytes(data)
    recovery = recover(file)
    assert not recovery.was_whole
    assert recovery.losses.messages == {}
    assert numbers(file) == list(range(COUNT))


def read(file: Path) -> list[int]:
    with BagDirectory(file.parent) as bag:
        return [number_of(message.data) for message in bag.messages(lambda _: True)]


def test_a_cut_compressed_file_loses_its_last_chunk_only(tmp_path: Path) -> None:
    file = write(tmp_path / "bag", compression="zstd")
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 2 // 3])
    recover(file)
    kept = numbers(file)
    assert kept == list(range(len(kept)))
    assert len(kept) > COUNT // 2


@pytest.mark.parametrize("closed", [True, False])
def test_damage_in_the_middle_costs_the_chunks_it_is_in(tmp_path: Path, closed: bool) -> None:
    data = write(tmp_path / "bag", whole=closed).read_bytes()
    rng = np.random.default_rng(2)
    chunk = 4096 // (LENGTH + 45)
    for trial in range(15):
        file = tmp_path / str(trial) / "damaged_0.mcap"
        file.parent.mkdir()
        damaged = bytearray(data)
        place = int(rng.integers(500, len(data) * 3 // 4))
        damaged[place : place + 300] = rng.bytes(300)
        file.write_bytes(damaged)
        recovery = recover(file)
        missing = set(range(COUNT)) - set(numbers(file))
        assert len(missing) <= 3 * chunk
        told = {topic: sum(n % 3 == place for n in missing) for place, topic in enumerate(TOPICS)}
        assert recovery.losses.messages == {topic: count for topic, count in told.items() if count}
        assert recovery.losses.is_exact == closed


def test_a_message_index_that_is_damaged_with_its_chunk_costs_what_is_told(tmp_path: Path) -> None:
    file = write(tmp_path / "bag", whole=True)
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[3]
    data = bytearray(file.read_bytes())
    place = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length // 2
    data[place : place + 3000] = bytes(3000)
    file.write_bytes(data)
    recovery = recover(file)
    missing = COUNT - len(numbers(file))
    assert missing > 10
    assert sum(recovery.losses.messages.values()) == missing
    assert f"{missing} messages: /one " in recovery.losses.lines()[0]


def test_a_missing_file_is_named_with_its_messages(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag", max_file_size=20_000)
    topic = bag.add_topic(BagTopic("/one", TYPE, DEFINITION, HASH))
    for number in range(COUNT):
        bag.write(topic, payload(number), 1000 + number, 1000 + number)
    bag.close()
    gone = tmp_path / "bag" / "bag_1.mcap"
    lost = len(numbers(gone))
    gone.rename(tmp_path / "elsewhere")
    recovery = recover_bag(tmp_path / "bag")
    assert recovery.losses.messages == {"/one": lost}
    assert recovery.losses.missing == ["bag_1.mcap"]
    (tmp_path / "elsewhere").rename(gone)
    assert recover_bag(tmp_path / "bag").messages == COUNT


def test_attachments_and_records_stay(tmp_path: Path, file_bytes: bytes) -> None:
    file = tmp_path / "bag_0.mcap"
    file.write_bytes(file_bytes)
    recover(file)
    with file.open("rb") as stream:
        reader = make_reader(stream)
        assert [a.data for a in reader.iter_attachments()] == [b"left: {}\n"]
        assert "needle_run" in [m.name for m in reader.iter_metadata()]


@pytest.mark.parametrize("content", [b"not an MCAP file", b"\x89MCAP0\r\n" + bytes(40)])
def test_another_file_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "bag_0.mcap"
    file.write_bytes(content)
    with pytest.raises(UserError, match=r"bag_0\.mcap: it does not begin as an MCAP file"):
        recover_bag(tmp_path)
    assert file.read_bytes() == content


def test_a_damaged_last_chunk_is_not_taken_for_a_cut_one(tmp_path: Path) -> None:
    """Cut short it would be readable again, with a message in it that nobody sent."""
    file = write(tmp_path / "bag", whole=True)
    data = bytearray(file.read_bytes())
    data[data.index(payload(COUNT - 1)) + 50] ^= 1
    file.write_bytes(data)
    recovery = recover(file)
    kept = numbers(file)
    assert kept == list(range(len(kept)))
    assert COUNT - 1 not in kept
    assert sum(recovery.losses.messages.values()) == COUNT - len(kept)


def test_without_room_for_a_copy_nothing_is_changed(tmp_path: Path) -> None:
    file = write(tmp_path / "bag")
    before = {path.name: path.read_bytes() for path in file.parent.iterdir()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before[file.name]) // 2, limits[1]))
    try:
        with pytest.raises(UserError, match="as much room; nothing was changed"):
            recover_bag(file.parent)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {path.name: path.read_bytes() for path in file.parent.iterdir()} == before


@pytest.mark.parametrize("limit", [100_000, 60_000, 60_100, 61_000, 63_500])
def test_a_disk_that_fills_within_a_chunk_leaves_a_whole_bag(tmp_path: Path, limit: int) -> None:
    """The kernel's limit on file sizes stands in for the disk: it cuts writes in the same way."""
    bag = BagWriter(tmp_path / "bag", chunk_size=20_000)
    topic = bag.add_topic(BagTopic("/one", TYPE, DEFINITION, HASH))
    bag.set_custom_data("run_info", "seed: 1")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    taken = 0
    try:
        with pytest.raises(BagWriteError, match="File too large"):
            for number in range(10_000):
                bag.write(topic, payload(number), 1000 + number, 1000 + number)
                taken += 1
        missing = bag.end_early()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with Reader(tmp_path / "bag") as reader:
        kept = [bytes(data) for _, _, data in reader.messages()]
        assert reader.message_count == len(kept)
    assert kept == [payload(number) for number in range(len(kept))]
    assert len(kept) == taken - missing["/one"]
    assert len(kept) * (LENGTH + 45) > limit - 2 * 21_000 - 4000
    assert recover_bag(tmp_path / "bag").was_whole


def test_a_lost_index_comes_back_as_the_library_writes_it(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag", chunk_size=4096)
    topic = bag.add_topic(BagTopic("/one", TYPE, DEFINITION, HASH))
    for number in range(COUNT):
        bag.write(topic, payload(number), 1000 + number, 1000, number + 1)
    bag.add_attachment("calibration.yaml", "application/yaml", b"left: {}\n", 1)
    bag.close()
    whole = bag.data_file.read_bytes()
    for length in (1, 8, 30, 300):
        bag.data_file.write_bytes(whole[:-length])
        McapEnding(bag._mcap, bag.data_file).write()
        assert bag.data_file.read_bytes() == whole
