"""Bags that tests write, damage and read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory

COUNT = 60
TOPICS = ("/a", "/b")
TYPE = "std_msgs/msg/UInt32"
ALL = list(range(COUNT))


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
    """Replace the data of a bag by a file of mcap's own writer; return the file."""
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
    """Return the one-line reason for which a bag is rejected."""
    with pytest.raises(UserError) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def refusal(bag: Path) -> str:
    """Return the reason of a rejection; reader and `recover` give the same, and change nothing."""
    before = {file: file.read_bytes() for file in bag.iterdir()}
    text = reason(bag)
    with pytest.raises(UserError) as caught:
        recover_bag(bag)
    assert str(caught.value) == text
    assert {file: file.read_bytes() for file in bag.iterdir()} == before
    return text
