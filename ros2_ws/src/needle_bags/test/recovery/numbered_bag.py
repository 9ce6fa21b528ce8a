"""Bags of numbered messages, 10 ms apart, read with mcap and rosbags."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from made_up_run import STORE, message, serialized
from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter, standard_topic
from needle_core.files.bag_topic import BagTopic

TYPE = "std_msgs/msg/UInt8MultiArray"
LATCHED = USUAL_QOS._replace(durability=QosDurability.TRANSIENT_LOCAL)
TOPICS = [
    BagTopic(name, TYPE, standard.definition, standard.type_hash, (LATCHED,))
    for name in ("/one", "/two", "/three")
    for standard in [standard_topic(name, TYPE)]
]
START, STEP = 1_700_000_000 * 10**9, 10_000_000
RUN = {"commit": "0123abc", "run_info": "seed: 3"}


@functools.cache
def payload(number: int) -> bytes:
    """Return a message with its number that does not end in 0, unlike zeros after a power cut."""
    content = np.frombuffer(np.random.default_rng(number).bytes(100) + b"\x01", np.uint8)
    layout = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=number)
    return serialized(message(TYPE, layout=layout, data=content))


def write(path: Path, count: int = 300, **how: int | str) -> Path:
    """Write a bag as our recorder does, in chunks of about 30 messages."""
    bag = BagWriter(path, **{"chunk_size": 4096, **how})  # type: ignore[arg-type]
    topics = [bag.add_topic(topic) for topic in TOPICS]
    bag.add_metadata("needle_run", RUN)
    for key, text in RUN.items():
        bag.set_custom_data(key, text)
    for node, gain in (("/one", 1.5), ("/two", 2.5)):
        text = f"{{{node}: {{ros__parameters: {{gain: {gain}}}}}}}"
        bag.add_metadata("parameters", {"node": node, "yaml": text})
    bag.add_metadata("parameter_change", {"stamp_ns": "5", "node": "/one", "value": "2.0"})
    bag._mcap.add_attachment(1, 1, "calibration.yaml", "application/yaml", b"left: {}\n")
    for number in range(count):
        time = START + number * STEP
        bag.write(topics[number % 3], payload(number), time, time - 1000, number // 3 + 1)
    bag.close()
    return path


def kill(path: Path) -> Path:
    """Leave a bag as a killed recorder does: no metadata.yaml, no index, half a chunk."""
    (path / "metadata.yaml").unlink()
    file = max(path.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * 0.75)])
    return path


def damage(file: Path, share: float = 0.5) -> int:
    """Change a bit of a message in a file; return the number of the message."""
    data = bytearray(file.read_bytes())
    found = {data.find(payload(number)): number for number in range(300)}
    place = min(at for at in found if at > len(data) * share)
    data[place + 50] ^= 1
    file.write_bytes(data)
    return found[place]


def contents(path: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in path.iterdir() if file.is_file()}


def numbers(path: Path) -> list[int]:
    """Return the message numbers of a whole bag; its data and its index must agree on them."""
    with Reader(path) as reader:
        found = [bytes(data) for _, _, data in reader.messages()]
        assert reader.message_count == len(found)
    metadata = yaml.safe_load((path / "metadata.yaml").read_text())
    indexed: list[bytes] = []
    for name in metadata["rosbag2_bagfile_information"]["relative_file_paths"]:
        with (path / name).open("rb") as stream:
            indexed += [m.data for _, _, m in make_reader(stream, True).iter_messages()]
    assert found == indexed
    messages: list[Any] = [STORE.deserialize_cdr(data, TYPE) for data in found]
    return [one.layout.data_offset for one in messages]


def chunks(file: Path) -> list[ChunkIndex]:
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes
