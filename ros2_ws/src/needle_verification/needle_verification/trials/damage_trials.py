"""Bags damaged at random places: what is read of them, before `recover` and after."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from needle_bags.format.bag_copy import standard_topic
from needle_bags.format.bag_metadata import (
    DataFile,
    bag_information,
    channel_metadata,
    write_metadata,
)
from needle_bags.format.bag_writer import BagWriter
from needle_bags.recovery.bag_recovery import DAMAGED, recover_bag
from needle_common.errors import UserError
from needle_common.files.bag_directory import METADATA_FILE, BagDirectory
from needle_common.files.mcap_file import RECORD_HEADER

KINDS: Final = ("chunked", "zstd", "unchunked", "split")
DAMAGES: Final = ("bit", "zeros", "cut", "noise", "file")
PLACES: Final = ("anywhere", "index", "summary", "metadata", "header")
_COUNT: Final = 900
_CRC: Final = slice(33, 37)
_STORE = get_typestore(Stores.ROS2_JAZZY)
_TOPICS: Final = {
    "/small": "std_msgs/msg/Header",
    "/large": "std_msgs/msg/UInt8MultiArray",
    "/text": "std_msgs/msg/String",
}

Key = tuple[str, int, bytes]


@dataclasses.dataclass(frozen=True)
class Extent:
    """Place of a message's bytes: if one of [start, end) is wrong, it need not be readable.

    Attributes
    ----------
    key : tuple
        Topic, log time [ns] and data.
    file : str
        Its file.
    start, end : int
        Its bytes.
    checked : bool
        Whether a checksum tells of a wrong byte.
    """

    key: Key
    file: str
    start: int
    end: int
    checked: bool


@dataclasses.dataclass(frozen=True)
class DamageTrial:
    """One damaged bag.

    Attributes
    ----------
    what : str
        Kind of bag and damage, for a person.
    faults : list of str
        What was not as it must be.
    lost : int
        Messages that were lost.
    was_read : bool
        Whether the damaged bag was still read in full before.
    """

    what: str
    faults: list[str]
    lost: int
    was_read: bool


def damage_trials(folder: Path, count: int, seed: int) -> Iterator[DamageTrial]:
    """Damage bags of all kinds in turn at random places, recover each, and look at it.

    Parameters
    ----------
    folder : Path
        Takes the bags.
    count, seed : int
        How many trials; for the places.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(exist_ok=True)
    sources = {kind: folder / kind for kind in KINDS}
    extents = {kind: _write(path, kind) for kind, path in sources.items()}
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        bag = folder / "damaged" / kind
        shutil.rmtree(bag, ignore_errors=True)
        shutil.copytree(sources[kind], bag)
        yield _trial(bag, kind, extents[kind], rng)


def _trial(bag: Path, kind: str, extents: list[Extent], rng: np.random.Generator) -> DamageTrial:
    damage, place = str(rng.choice(DAMAGES)), str(rng.choice(PLACES))
    name, start, end = _damage(bag, damage, place, rng)
    what = f"{kind}: {damage} at {start} to {end} of {name}"
    recorded = Counter(extent.key for extent in extents)
    hurt = [e for e in extents if e.file == name and e.start < end and e.end > start]
    readable = recorded - Counter(extent.key for extent in hurt)
    # Without a checksum nothing tells a wrong byte within a message.
    altered = sum(not extent.checked for extent in hurt)
    before = _read(bag)
    faults: list[str] = []
    if before is not None and (
        before.total() != recorded.total() or (before - recorded).total() > altered
    ):
        faults.append(f"read before: {before.total()} of {recorded.total()} messages, in silence")
    files = _contents(bag)
    try:
        recovery, after = recover_bag(bag), _read(bag)
    except UserError as error:
        return DamageTrial(what, [f"not recovered: {error}"], 0, before is not None)
    if after is None:
        return DamageTrial(what, ["not read after recover"], 0, before is not None)
    if gone := readable - after:
        faults.append(f"{gone.total()} readable messages are gone")
    if new := (after - recorded).total() - altered:
        faults += [f"{new} messages that nobody recorded"] if new > 0 else []
    told = recovery.losses
    lost = _by_topic(recorded) - _by_topic(after)
    if not told.is_exact or Counter(told.messages) != lost:
        faults.append(f"lost {dict(lost)}, told {told.lines()}")
    if recovery.was_whole and (after != recorded) and not altered:
        faults.append("called whole")
    if missing := files - _contents(bag):
        faults.append(f"{len(missing)} of the damaged files are destroyed")
    if not recover_bag(bag).was_whole:
        faults.append("not whole after recover")
    return DamageTrial(what, faults, lost.total(), before is not None)


def _damage(bag: Path, damage: str, place: str, rng: np.random.Generator) -> tuple[str, int, int]:
    """Damage one file of a bag; return its name and which bytes."""
    files = sorted(bag.glob("*.mcap"))
    file = bag / METADATA_FILE if place == "metadata" else files[rng.integers(len(files))]
    if damage == "file" and len(files) > 1 and place != "metadata":
        size = file.stat().st_size
        file.unlink()
        return file.name, 0, size
    data = bytearray(file.read_bytes())
    low, high = _span(file, bytes(data), place, rng)
    start = int(rng.integers(low, high))
    end = min(len(data), start + int(rng.integers(1, 3000)))
    if damage == "cut":
        end = len(data)
        del data[start:]
    elif damage == "zeros":
        data[start:end] = bytes(end - start)
    elif damage == "noise":
        data[start:end] = rng.bytes(end - start)
    else:
        end = start + 1
        data[start] ^= 1 << int(rng.integers(8))
    file.write_bytes(data)
    return file.name, start, end


def _span(file: Path, data: bytes, place: str, rng: np.random.Generator) -> tuple[int, int]:
    if file.name == METADATA_FILE or place == "anywhere":
        return 0, len(data)
    if place == "header":
        return 0, 60
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunks = summary.chunk_indexes
    if place == "index" and chunks:
        chunk = chunks[rng.integers(len(chunks))]
        begin = chunk.chunk_start_offset + chunk.chunk_length
        return begin, begin + chunk.message_index_length
    return int.from_bytes(data[-28:-20], "little"), len(data)


def _read(bag: Path) -> Counter[Key] | None:
    """Return what every tool reads; None where each says why it does not."""
    try:
        with BagDirectory(bag) as directory:
            store = directory.typestore()
            found = list(directory.messages(lambda _: True))
            for message in found:
                directory.deserialize(store, message)
    except UserError:
        return None
    return Counter((m.topic, m.log_time, m.data) for m in found)


def _by_topic(keys: Counter[Key]) -> Counter[str]:
    return Counter(topic for topic, _, _ in keys.elements())


def _contents(bag: Path) -> Counter[bytes]:
    return Counter(
        hashlib.sha256(file.read_bytes()).digest()
        for file in bag.iterdir()
        if file.name == METADATA_FILE or ".mcap" in file.name or DAMAGED in file.name
    )


def _messages() -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time and data; every message differs, and is of its type."""
    rng = np.random.default_rng(1)
    types = _STORE.types
    names = list(_TOPICS)
    for number in range(_COUNT):
        name = names[number % len(names)]
        content: Any
        if name == "/small":
            stamp = types["builtin_interfaces/msg/Time"](sec=number, nanosec=7)
            content = types[_TOPICS[name]](stamp=stamp, frame_id="rig")
        elif name == "/large":
            layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=number)
            data = rng.integers(0, 4, 400, np.uint8) * (number % 2)
            content = types[_TOPICS[name]](layout=layout, data=data)
        else:
            content = types[_TOPICS[name]](data=f"message {number} " + "x" * (number % 30))
        time = 1_700_000_000_000_000_000 + number * 1_000_000 + int(rng.integers(500_000))
        yield name, time, bytes(_STORE.serialize_cdr(content, _TOPICS[name]))


def _write(bag: Path, kind: str) -> list[Extent]:
    topics = [standard_topic(name, type_name) for name, type_name in _TOPICS.items()]
    if kind == "unchunked":
        # As rosbag2's own recorder writes them with config/rosbag2_mcap.yaml.
        bag.mkdir()
        content = DataFile(f"{kind}_0.mcap")
        with (bag / content.name).open("wb") as stream:
            mcap = Writer(stream, use_chunking=False, compression=CompressionType.NONE)
            mcap.start("ros2", "rosbag2")
            numbers = {}
            for topic in topics:
                text = topic.definition.encode()
                schema = mcap.register_schema(topic.type_name, "ros2msg", text)
                numbers[topic.name] = mcap.register_channel(
                    topic.name, "cdr", schema, channel_metadata(topic)
                )
            for name, time, data in _messages():
                mcap.add_message(numbers[name], time, data, time)
                content.add(name, time)
            mcap.finish()  # type: ignore[no-untyped-call]
        write_metadata(bag, bag_information([content], topics, {}, "jazzy"))
    else:
        writer = BagWriter(
            bag,
            chunk_size=8000,
            compression="zstd" if kind == "zstd" else "none",
            max_file_size=40_000 if kind == "split" else 0,
        )
        places = {topic.name: writer.add_topic(topic) for topic in topics}
        for number, (name, time, data) in enumerate(_messages()):
            writer.write(places[name], data, time, time, number // len(topics) + 1)
        writer.close()
    return [extent for file in sorted(bag.glob("*.mcap")) for extent in _extents(file)]


def _extents(file: Path) -> Iterator[Extent]:
    data = file.read_bytes()
    with file.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        found = [(c.topic, m) for _, c, m in reader.iter_messages()]
    position = 0
    for topic, message in found:
        key = (topic, message.log_time, message.data)
        chunk = next(
            (
                c
                for c in summary.chunk_indexes
                if c.message_start_time <= message.log_time <= c.message_end_time
            ),
            None,
        )
        if chunk is None:
            position = data.index(message.data, position) - 22 - RECORD_HEADER.size
            length = RECORD_HEADER.size + 22 + len(message.data)
            yield Extent(key, file.name, position, position + length, False)
            position += length
        else:
            # The rest of its header is in the index, too.
            begin = chunk.chunk_start_offset + _CRC.start
            yield Extent(key, file.name, begin, chunk.chunk_start_offset + chunk.chunk_length, True)
