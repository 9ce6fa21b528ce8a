"""Parameter files on a node's command line: a section for a node that does not exist is refused."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from needle_common.errors import UserError

NODES = (
    "recorder",
    "sim_rig",
    "drive_emulator",
    "device_driver",
    "stereo_camera",
    "stereo_tracker",
    "plane_controller",
    "operator",
    "player",
)
"""What the rig's nodes are called."""
_SECTION = "ros__parameters"


def refuse_unknown_nodes(arguments: Sequence[str]) -> None:
    """Refuse files that name nodes which the rig does not have: ROS passes over them in silence.

    Parameters
    ----------
    arguments : sequence of str
        A node's command line.

    Raises
    ------
    UserError
        For such a file; one that cannot be read is left to rclpy, which says so.
    """
    renamed = {word.partition(":=")[2] for word in arguments if word.startswith("__node:=")}
    for option, path in itertools.pairwise(arguments):
        if option != "--params-file":
            continue
        try:
            document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError):
            continue
        for name in _sections(document):
            last = name.rstrip("/").rpartition("/")[2]
            if "*" not in name and last not in (*NODES, *renamed):
                raise UserError(f"{path}: unknown node '{name}' (known: {', '.join(NODES)})")


def _sections(document: Any, above: str = "") -> Iterator[str]:
    if not isinstance(document, dict):
        return
    for key, value in document.items():
        if key == _SECTION:
            yield above
        else:
            yield from _sections(value, f"{above}/{key}".replace("//", "/") if above else str(key))
