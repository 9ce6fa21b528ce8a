"""Files cut and damaged at random places; the readers of rosbags and mcap are the oracles."""

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
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from needle_bringup.bag_metadata import BagTopic
from needle_bringup.bag_writer import BagWriteError, BagWriter
from needle_bringup.mcap_repair import repair, scan_file
from needle_bringup.mcap_scan import NotMcapError

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPE = "std_msgs/msg/String"
DEFINITION, HASH = STORE.generate_msgdef(TYPE, ros_version=2)[0], STORE.hash_rihs01(TYPE)
TOPICS = ("/one", "/two", "/three")
LENGTH = 100
COUNT = 600


def payload(number: int) -> bytes:
    """A message that tells its number and ends in no zero, as a power cut's zeros do."""
    return number.to_bytes(4, "little") + np.random.default_rng(number).bytes(LENGTH) + b"\x01"


def write(directory: Path, *, compression: str = "none", whole: bool = False) -> Path:
    """A whole file of many chunks, or one as a killed recorder leaves it."""
    bag = BagWriter(directory, chunk_size=4096, compression=compression)
    topics = [bag.add_topic(BagTopic(name, TYPE, DEFINITION, HASH)) for name in TOPICS]
    bag.add_metadata("needle_run", {"commit": "0123abc"})
    for number in range(COUNT):
        bag.write(topics[number % 3], payload(number), 1000 + number, 1000 + number, number)
        if number == COUNT // 2:
            bag.add_attachment("calibration.yaml", "application/yaml", b"left: {}\n", 1)
    bag.flush()
    killed = bag.data_file.read_bytes()
    bag.close()
    if not whole:
        bag.data_file.write_bytes(killed)
    return bag.data_file


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
    assert all(data == payload(int.from_bytes(data[:4], "little")) for data in by_rosbags)
    require_indexes_in_place(file)
    return sorted(int.from_bytes(data[:4], "little") for data in by_rosbags)


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
    return data[: rng.integers(0, len(data))]


def cut_and_zeros(data: bytes, rng: np.random.Generator) -> bytes:
    return cut(data, rng) + bytes(rng.integers(1, 5000))


@pytest.mark.parametrize("damage", [cut, cut_and_zeros])
def test_a_file_cut_anywhere_keeps_every_whole_message(
    tmp_path: Path, file_bytes: bytes, damage: Callable[[bytes, np.random.Generator], bytes]
) -> None:
    rng = np.random.default_rng(5)
    file = tmp_path / "bag_0.mcap"
    for _ in range(40):
        data = damage(file_bytes, rng)
        file.write_bytes(data)
        recovery = repair(file, scan_file(file), library="test")
        kept = numbers(file)
        assert len(kept) == recovery.messages
        there = sum(payload(number) in data for number in range(COUNT))
        assert kept == list(range(there))


def test_a_cut_compressed_file_loses_its_last_chunk_only(tmp_path: Path) -> None:
    data = write(tmp_path / "bag", compression="zstd").read_bytes()
    file = tmp_path / "cut_0.mcap"
    file.write_bytes(data[: len(data) * 2 // 3])
    repair(file, scan_file(file), library="test")
    kept = numbers(file)
    assert kept == list(range(len(kept)))
    assert len(kept) > COUNT // 2


def test_damage_in_the_middle_costs_the_chunks_it_is_in(tmp_path: Path) -> None:
    data = bytearray(write(tmp_path / "bag", whole=True).read_bytes())
    rng = np.random.default_rng(2)
    file = tmp_path / "damaged_0.mcap"
    chunk = 4096 // (LENGTH + 35)
    for _ in range(20):
        damaged = bytearray(data)
        place = int(rng.integers(100, len(data) * 3 // 4))
        damaged[place : place + 300] = rng.bytes(300)
        file.write_bytes(damaged)
        recovery = repair(file, scan_file(file), library="test")
        assert recovery.bytes_lost >= 0
        assert not recovery.was_whole
        missing = set(range(COUNT)) - set(numbers(file))
        assert len(missing) <= 3 * chunk
        if missing:
            assert max(missing) - min(missing) + 1 == len(missing)


def test_a_whole_file_is_not_touched(tmp_path: Path) -> None:
    file = write(tmp_path / "bag", whole=True)
    before, changed = file.read_bytes(), file.stat().st_mtime_ns
    recovery = repair(file, scan_file(file), library="test")
    assert recovery.was_whole
    assert recovery.messages == COUNT
    assert (file.read_bytes(), file.stat().st_mtime_ns) == (before, changed)


def test_what_is_repaired_is_whole(tmp_path: Path, file_bytes: bytes) -> None:
    file = tmp_path / "bag_0.mcap"
    file.write_bytes(file_bytes[:-1000])
    first = repair(file, scan_file(file), library="test")
    again = repair(file, scan_file(file), library="test")
    assert again.was_whole
    assert again.messages == first.messages


def test_attachments_and_records_stay(tmp_path: Path, file_bytes: bytes) -> None:
    file = tmp_path / "bag_0.mcap"
    file.write_bytes(file_bytes)
    repair(file, scan_file(file), library="test")
    with file.open("rb") as stream:
        reader = make_reader(stream)
        assert [a.data for a in reader.iter_attachments()] == [b"left: {}\n"]
        assert "needle_run" in [m.name for m in reader.iter_metadata()]


@pytest.mark.parametrize("content", [b"not an MCAP file", b"\x89MCAP0\r\n" + bytes(40)])
def test_another_file_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "bag_0.mcap"
    file.write_bytes(content)
    with pytest.raises(NotMcapError):
        scan_file(file)


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
    assert len(kept) * (LENGTH + 35) > limit - 2 * 21_000 - 4000
    assert repair(bag.data_file, scan_file(bag.data_file), library="test").was_whole


def test_a_damaged_last_chunk_is_not_taken_for_a_cut_one(tmp_path: Path) -> None:
    """Cut short it would be readable again, with a message in it that nobody sent."""
    data = bytearray(write(tmp_path / "bag", whole=True).read_bytes())
    last = payload(COUNT - 1)
    place = data.index(last)
    data[place + 50] ^= 1
    file = tmp_path / "damaged_0.mcap"
    file.write_bytes(data)
    repair(file, scan_file(file), library="test")
    kept = numbers(file)
    assert kept == list(range(len(kept)))
    assert COUNT - 1 not in kept


def test_a_damaged_message_index_is_written_again(tmp_path: Path) -> None:
    whole = write(tmp_path / "bag", whole=True).read_bytes()
    (chunk,) = (c for c in scan_file(write(tmp_path / "other")).chunks[3:4])
    file = tmp_path / "damaged_0.mcap"
    for length in (5, 60, chunk.index.message_index_length):
        data = bytearray(whole)
        data[chunk.end : chunk.end + length] = b"\xff" * length
        file.write_bytes(data)
        recovery = repair(file, scan_file(file), library="test")
        assert not recovery.was_whole
        assert numbers(file) == list(range(COUNT))
        begin, end = chunk.end, chunk.end + chunk.index.message_index_length
        assert file.read_bytes()[begin:end] == whole[begin:end]


def test_a_lost_summary_comes_back_as_the_library_writes_it(tmp_path: Path) -> None:
    whole = write(tmp_path / "bag", whole=True).read_bytes()
    file = tmp_path / "cut_0.mcap"
    for length in (1, 8, 30, 300, 1500):
        file.write_bytes(whole[:-length])
        repair(file, scan_file(file), library="test")
        assert file.read_bytes() == whole
