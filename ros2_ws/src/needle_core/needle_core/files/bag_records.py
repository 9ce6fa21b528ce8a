"""Metadata records of an MCAP file: what a recorder left there for metadata.yaml's `custom_data`.

Ours writes one record of the run at its beginning and one for every node's parameters and every
change of them, and, as rosbag2 does, the whole of metadata.yaml at the end.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any, Final

import yaml
from mcap.records import Metadata

from needle_core.files.plain_yaml import load_plain

# Name of the records that rosbag2 writes, and their keys.
METADATA_RECORD: Final = "rosbag2"
DISTRO_KEY: Final = "ROS_DISTRO"
METADATA_KEY: Final = "serialized_metadata"
RUN_RECORD: Final = "needle_run"


def custom_data_of(records: Iterable[Metadata]) -> dict[str, str]:
    """Return the `custom_data` of a recording, as far as the records in its files have them."""
    custom: dict[str, str] = {}
    parameters: dict[str, Any] = {}
    changes: list[Any] = []
    whole: dict[str, Any] = {}
    for record in records:
        values = record.metadata
        if record.name == RUN_RECORD:
            custom.update(values)
        # A text that is no YAML says nothing.
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            if record.name == "parameters":
                parameters.update(load_plain(values.get("yaml", "")))
            elif record.name == "parameter_change":
                changes.append({key: load_plain(text) for key, text in values.items()})
            elif record.name == METADATA_RECORD and METADATA_KEY in values:
                whole = load_plain(values[METADATA_KEY]).get("custom_data") or whole
    if parameters:
        custom["parameters"] = yaml.safe_dump(parameters)
    if changes:
        custom["parameter_changes"] = yaml.safe_dump(changes)
    return custom | {str(key): str(value) for key, value in whole.items()}


def distribution_of(records: Iterable[Metadata]) -> str:
    """Return the ROS distribution that the records name; empty where they name none."""
    told = (r.metadata.get(DISTRO_KEY, "") for r in records if r.name == METADATA_RECORD)
    return next(filter(None, told), "")
