"""Bags of numbered messages, 10 ms apart, read with mcap and rosbags."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import yaml
from mcap.reader import make_reader
from mcap.records import ChunkIndex, Message
from mcap.stream_reader import StreamReader
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


def number_of(data: bytes) -> int:
    return int(STORE.deserialize_cdr(data, TYPE).layout.data_offset)  # type: ignore[attr-defined]


def write(
    path: Path,
    count: int = 300,
    *,
    first: int = 0,
    run: dict[str, str] | None = None,
    **how: int | str,
) -> Path:
    """Write a bag as our recorder does, in chunks of about 30 messages."""
    bag = BagWriter(path, **{"chunk_size": 4096, **how})  # type: ignore[arg-type]
    topics = [bag.add_topic(topic) for topic in TOPICS]
    run = RUN if run is None else run
    if run:
        bag.add_metadata("needle_run", run)
    for key, text in run.items():
        bag.set_custom_data(key, text)
    for node, gain in (("/one", 1.5), ("/two", 2.5)):
        text = f"{{{node}: {{ros__parameters: {{gain: {gain}}}}}}}"
        bag.add_metadata("parameters", {"node": node, "yaml": text})
    bag.add_metadata("parameter_change", {"stamp_ns": "5", "node": "/one", "value": "2.0"})
    bag._mcap.add_attachment(1, 1, "calibration.yaml", "application/yaml", b"left: {}\n")
    for number in range(first, first + count):
        time = START + number * STEP
        bag.write(topics[number % 3], payload(number), time, time - 1000, number // 3 + 1)
    bag.close()
    return path


def kill(path: Path, share: float = 0.75) -> Path:
    """Leave a bag as a killed recorder does: no metadata.yaml, no index, half a chunk."""
    (path / "metadata.yaml").unlink()
    file = max(path.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    return path


def damage(file: Path, share: float = 0.5) -> int:
    """Change a byte of a message in a file; return the number of the message."""
    data = file.read_bytes()
    found = {data.find(payload(number)): number for number in range(300)}
    place = min(at for at in found if at > len(data) * share)
    flip(file, place + 50)
    return found[place]


def contents(path: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in path.iterdir() if file.is_file()}


def numbers(path: Path) -> list[int]:
    """Return the message numbers of a whole bag; all readers must agree on them."""
    with Reader(path) as reader:
        found = [bytes(data) for _, _, data in reader.messages()]
        assert reader.message_count == len(found)
    files = [path]
    if path.is_dir():
        metadata = yaml.safe_load((path / "metadata.yaml").read_text())
        files = [path / n for n in metadata["rosbag2_bagfile_information"]["relative_file_paths"]]
    indexed: list[bytes] = []
    streamed: list[bytes] = []
    for file in files:
        with file.open("rb") as stream:
            indexed += [m.data for _, _, m in make_reader(stream, True).iter_messages()]
            stream.seek(0)
            records = StreamReader(stream, validate_crcs=True).records
            streamed += [record.data for record in records if isinstance(record, Message)]
    assert found == indexed == streamed
    return [number_of(data) for data in found]


def chunks(file: Path) -> list[ChunkIndex]:
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def flip(file: Path, place: int, bits: int = 1) -> None:
    """Change bits of a byte."""
    data = bytearray(file.read_bytes())
    data[place] ^= bits
    file.write_bytes(data)
