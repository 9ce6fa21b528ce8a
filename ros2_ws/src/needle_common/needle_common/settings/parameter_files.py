"""Parameter files: read, and a section for a node that does not exist refused, or said."""

from __future__ import annotations

import difflib
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
    "simulated_operator",
    "live_view",
    "openigtlink",
    "player",
)
"""Names of the rig's nodes."""
_SECTION = "ros__parameters"
_CLOSE = 0.7  # names that have so much in common are one, misspelt

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
    document = _document(path)
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


def foreign_nodes(arguments: Sequence[str]) -> list[str]:
    """Return whom else a node's parameter files name; misspelt names of this rig are refused.

    A rig's file is often shared by all its nodes, those of other packages too. But ROS passes over
    a section in silence: with its name misspelt, a node would run on its defaults.

    Parameters
    ----------
    arguments : sequence of str
        A node's command line.

    Returns
    -------
    list of str
        One line for each file that names nodes of others.

    Raises
    ------
    UserError
        For a file that cannot be read, and a name that is close to a node of this rig.
    """
    renamed = {word.partition(":=")[2] for word in arguments if word.startswith("__node:=")}
    lines = []
    for option, path in itertools.pairwise(arguments):
        if option != "--params-file":
            continue
        foreign = []
        for name in _sections(_document(Path(path))):
            last = name.rstrip("/").rpartition("/")[2]
            if "*" in name or last in (*NODES, *renamed):
                continue
            meant = difflib.get_close_matches(last, NODES, n=1, cutoff=_CLOSE)
            if meant:
                raise UserError(f"{path}: unknown node '{name}', did you mean '{meant[0]}'?")
            foreign.append(name)
        if foreign:
            lines.append(f"{path}: passed over, no nodes of this rig: {', '.join(foreign)}")
    return lines


def _document(path: Path) -> Any:
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}: not YAML{where}: {getattr(error, 'problem', error)}") from error


def _sections(document: Any, above: str = "") -> Iterator[str]:
    if not isinstance(document, dict):
        return
    for key, value in document.items():
        if key == _SECTION:
            yield above
        else:
            yield from _sections(value, f"{above}/{key}".replace("//", "/") if above else str(key))
