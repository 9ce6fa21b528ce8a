"""Files ended where a full disk cut them off; the readers of rosbags and mcap are the oracles."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from needle_bags.format.bag_copy import standard_text, standard_topic
from needle_bags.format.bag_writer import BagWriteError, BagWriter
from needle_bags.format.mcap_ending import McapEnding
from needle_bags.recovery.bag_recovery import recover_bag

TOPIC = standard_topic("/one", "std_msgs/msg/String")
LENGTH = 120


def payload(number: int) -> bytes:
    return standard_text(f"{number:0{LENGTH}}")


@pytest.mark.parametrize("limit", [60_000, 63_500])
def test_a_disk_that_fills_within_a_chunk_leaves_a_whole_bag(tmp_path: Path, limit: int) -> None:
    """The kernel's limit on file sizes stands in for the disk: it cuts writes in the same way."""
    bag = BagWriter(tmp_path / "bag", chunk_size=20_000)
    topic = bag.add_topic(TOPIC)
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
    topic = bag.add_topic(TOPIC)
    for number in range(600):
        bag.write(topic, payload(number), 1000 + number, 1000, number + 1)
    bag.add_attachment("calibration.yaml", "application/yaml", b"left: {}\n", 1)
    bag.close()
    whole = bag.data_file.read_bytes()
    for length in (1, 30, 300):
        bag.data_file.write_bytes(whole[:-length])
        McapEnding(bag._mcap, bag.data_file).write()
        assert bag.data_file.read_bytes() == whole
