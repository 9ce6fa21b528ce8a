"""Recording of a virtual run into a bag, without ROS.

Log times are virtual, and paths, dates and host are stored only in metadata.yaml, so that equal
seeds give byte-identical MCAP files.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.typesys import Stores, get_typestore

from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter, standard_topic
from needle_bags.recording.provenance import commit, distribution, versions
from needle_core.component import Component, Delivery, Input, Output
from needle_core.convert import ros_type, to_ros
from needle_core.files.bag_topic import BagTopic
from needle_core.files.mcap_file import RUN_RECORD
from needle_core.message_types import rosbags_types
from needle_core.settings.parameter_files import absolute_name


class BagTap:
    """Writes all publications of a run into a bag.

    Parameters
    ----------
    directory : Path
        The bag.
    components : iterable of Component
        Components of the run; their topics and settings are stored.
    others : iterable of Output
        Topics that the runner itself publishes.
    run_info : mapping
        Description of the run.
    """

    def __init__(
        self,
        directory: Path,
        components: Iterable[Component],
        others: Iterable[Output],
        run_info: Mapping[str, Any],
    ) -> None:
        components = list(components)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._types = rosbags_types(self._store)
        self._writer = BagWriter(directory, distribution=distribution(), describe_itself=False)
        self._sequence: Counter[tuple[str, str]] = Counter()
        rows: list[Input | Output] = [*others]
        for component in components:
            rows += [*component.outputs, *component.inputs]
        first: dict[str, Input | Output] = {}
        for row in rows:
            first.setdefault(row.topic, row)
        for row in first.values():
            self._writer.add_topic(self._topic(row))
        texts = {"run_info": json.dumps(run_info), "commit": commit()}
        self._writer.add_metadata(RUN_RECORD, texts)
        for key, text in {**texts, "versions": json.dumps(versions())}.items():
            self._writer.set_custom_data(key, text)
        self._write_parameters(components)

    def __call__(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        """Write a publication."""
        ros_message = to_ros(message, self._types)
        data = bytes(self._store.serialize_cdr(ros_message, ros_type(output.message)))
        self._sequence[sender, output.topic] += 1
        sequence = self._sequence[sender, output.topic]
        topic = absolute_name(output.topic)
        self._writer.write(topic, data, stamp_ns, stamp_ns, sequence)

    def close(self) -> None:
        """Complete the bag."""
        self._writer.close()

    def _topic(self, row: Input | Output) -> BagTopic:
        topic = standard_topic(absolute_name(row.topic), ros_type(row.message))
        return dataclasses.replace(topic, offered_qos=(_offered(row.delivery),))

    def _write_parameters(self, components: Iterable[Component]) -> None:
        document = {}
        for component in components:
            if component.settings is None:
                continue
            values = {
                name: list(value) if isinstance(value, tuple) else value
                for name, value in dataclasses.asdict(component.settings).items()
            }
            node = f"/{component.name}"
            document[node] = {"ros__parameters": values}
            record = {"node": node, "yaml": yaml.safe_dump({node: document[node]})}
            self._writer.add_metadata("parameters", record)
        self._writer.set_custom_data("parameters", yaml.safe_dump(document))


def _offered(delivery: Delivery) -> Any:
    reliability, durability = QosReliability, QosDurability
    return USUAL_QOS._replace(
        depth=delivery.depth,
        reliability=reliability.RELIABLE if delivery.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if delivery.latched else durability.VOLATILE,
    )
