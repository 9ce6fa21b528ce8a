"""Parameter files: read, and a section for a node that does not exist refused."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
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

Parameters = dict[str, dict[str, Any]]


def read_parameters(path: Path, nodes: Sequence[str] = NODES) -> Parameters:
    """Return a ROS parameter file as node name -> parameter name -> value.

    Parameters
    ----------
    path : Path
        The file.
    nodes : sequence of str
        Whom it may name.

    Raises
    ------
    UserError
        If it cannot be read, is no such file, or names another node.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}: not YAML{where}: {getattr(error, 'problem', error)}") from error
    if not isinstance(document, Mapping):
        raise UserError(f"{path}: not a ROS parameter file (NODE: {{ros__parameters: ...}})")
    parameters: Parameters = {}
    for key, section in document.items():
        name = str(key).removeprefix("/")
        if name not in nodes:
            raise UserError(f"{path}: unknown node '{key}' (known: {', '.join(nodes)})")
        if not isinstance(section, Mapping) or list(section) != ["ros__parameters"]:
            raise UserError(f"{path}: '{key}' wants one entry, ros__parameters")
        values = section["ros__parameters"]
        if not isinstance(values, Mapping):
            raise UserError(f"{path}: '{key}' wants NAME: VALUE pairs under ros__parameters")
        parameters[name] = {str(k): value for k, value in values.items()}
    return parameters


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
