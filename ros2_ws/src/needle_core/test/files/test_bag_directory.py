"""Bags of any recorder: read completely, or the missing part is reported."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from mcap.writer import CompressionType
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from needle_core.files.bag_directory import BagDirectory

from .made_bags import (
    ALL,
    COUNT,
    TOPICS,
    begin,
    change,
    payload,
    plain,
    read,
    reason,
    rosbag,
    write_mcap,
)


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


# ---- damaged or malicious -----------------------------------------------------------------------


def test_a_wrong_bit_in_a_message_or_a_missing_end_is_refused(bag: Path) -> None:
    file = plain(bag)
    whole = file.read_bytes()
    place = whole.index(payload(31)) + 5
    file.write_bytes(whole[:place] + b"\x07" + whole[place + 1 :])
    assert "recover" in reason(bag)
    for length in range(0, len(whole) - 1, 97):
        file.write_bytes(whole[:length])
        assert "recover" in reason(bag)


@pytest.mark.parametrize("chunked", [True, False])
def test_an_index_with_other_messages_is_rejected(tmp_path: Path, chunked: bool) -> None:
    file = tmp_path / "a.mcap"
    with file.open("wb") as stream:
        mcap = begin(stream, use_chunking=chunked)
        for number in range(COUNT):
            mcap.add_message(1 + number % 2, 1000 + number, payload(number), 1, number)
        mcap._Writer__statistics.channel_message_counts = {1: COUNT - 1, 2: 1}  # type: ignore[attr-defined]
        mcap.finish()  # type: ignore[no-untyped-call]
    assert "its index lists 60, or of others" in reason(file)


def test_metadata_with_other_messages_are_rejected(bag: Path) -> None:
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    a, b = metadata["topics_with_message_count"]
    for wrong in (
        {"message_count": COUNT + 1},
        {"topics_with_message_count": [a]},
        {"topics_with_message_count": [a, {**b, "message_count": 1 + COUNT // 2}]},
        {"relative_file_paths": [*metadata["relative_file_paths"], "bag_1.mcap"]},
    ):
        change(bag, **{**metadata, **wrong})
        assert "recover" in reason(bag)
