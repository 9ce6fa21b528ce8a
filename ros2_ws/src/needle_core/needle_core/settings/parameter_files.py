"""Parameter files, whose sections are matched with the full names of nodes as in ROS."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from needle_core.errors import UserError
from needle_core.files.yaml_files import read_yaml

NODES = (
    *("recorder", "sim_rig", "drive_emulator", "device_driver", "stereo_camera", "stereo_tracker"),
    *("plane_controller", "operator", "simulated_operator", "live_view", "openigtlink", "player"),
    *("console", "tracked_tip", "peer_topics"),
)
"""Names of the rig's nodes."""
_SECTION = "ros__parameters"
_FORM = "NODE: {ros__parameters: ...}"
_WILDCARDS = ("*", "**")
_OVERRIDE = "-p "
_SIMILARITY = 0.7  # a name this similar to a known one is a misspelling

Parameters = dict[str, dict[str, Any]]
"""Node -> parameter -> value."""
Sections = dict[str, dict[str, Any]]
"""Section name in the file -> parameter -> value."""
T = TypeVar("T")


def read_sections(path: Path) -> Sections:
    """Return the sections of a ROS parameter file.

    Raises
    ------
    UserError
        If it cannot be read, is not a parameter file, or repeats a section or a parameter.
    """
    document = read_yaml(path)
    if not isinstance(document or {}, Mapping):
        raise UserError(f"{path}: not a ROS parameter file ({_FORM})")
    sections = list(_sections(path, document or {}))
    _unique(path, ((absolute_name(name), None) for name, _ in sections))
    return {name: _unique(f"{path}: {name}", _flat(values)) for name, values in sections}


def matching_sections(source: object, sections: Sections, node: str, kind: str) -> Sections:
    """Return the sections that match a node; empty if none is meant for a node of this kind.

    Parameters
    ----------
    source : object
        File or option, for errors.
    sections : mapping
        All sections of the source.
    node : str
        Full name of the node, after remapping.
    kind : str
        Name of its executable: its name without remapping.

    Raises
    ------
    UserError
        If sections for such a node exist but none matches this one, which would then run with its
        defaults, or if the name of a section is a misspelt node name.
    """
    own = (kind, _last(node))
    for name in sections:
        if _last(name) not in (*NODES, *own, *_WILDCARDS):
            close = difflib.get_close_matches(_last(name), NODES, n=1, cutoff=_SIMILARITY)
            if close:
                raise UserError(f"{source}: unknown node '{name}', did you mean '{close[0]}'?")
    meant = [name for name in sections if _last(name) in own]
    meant = meant or [name for name in sections if _last(name) in _WILDCARDS]
    reached = {name: values for name, values in sections.items() if _matches(name, node)}
    if meant and reached.keys().isdisjoint(meant):
        raise UserError(
            f"{source}: section '{meant[0]}' is for {absolute_name(meant[0])}, this node is "
            f"{node}: write '{node}', '/**/{_last(node)}' or '/**'"
        )
    return reached


def values_for(source: object, sections: Sections, node: str, kind: str) -> dict[str, Any] | None:
    """Return the parameters that sections set in a node; None if no section matches.

    Arguments and errors are those of `matching_sections`.
    """
    reached = matching_sections(source, sections, node, kind)
    if not reached:
        return None
    return {name: value for values in reached.values() for name, value in values.items()}


def missing_section_warning(source: object, sections: Sections, node: str) -> str:
    """Return the warning that a source has no section for a node of this kind."""
    return f"{source}: no section for {node}: it has {', '.join(sections) or 'none'}"


def command_line_sections(argv: Sequence[str]) -> list[tuple[str, Sections]]:
    """Return the parameters on a node's command line: (file or `-p` as given, sections).

    Raises
    ------
    UserError
        For the same reasons as `read_sections`.
    """
    given: list[tuple[str, Sections]] = []
    ros = argv[argv.index("--ros-args") :] if "--ros-args" in argv else []
    for option, text in itertools.pairwise(ros):
        if option == "--params-file":
            given.append((text, read_sections(Path(text))))
        elif option in ("-p", "--param"):
            *of, name = text.partition(":=")[0].split(":")
            given.append((f"{_OVERRIDE}{text}", {of[0] if of else "/**": {name: None}}))
    return given


def check_command_line(argv: Sequence[str], node: str) -> list[str]:
    """Check that the parameters on a node's command line take effect.

    Parameters
    ----------
    argv : sequence of str
        The command line, with the executable.
    node : str
        Full name of the node, after remapping.

    Returns
    -------
    list of str
        A warning for each file or `-p` without a section for a node of this kind.

    Raises
    ------
    UserError
        For the reasons of `read_sections` and `matching_sections`, or if a file overrides a `-p`.
    """
    warnings = []
    overrides: dict[str, str] = {}
    # As in rcl, a section keeps the position of its first occurrence, and the last section wins.
    kept: dict[str, dict[str, str]] = {}
    for source, sections in command_line_sections(argv):
        reached = matching_sections(source, sections, node, Path(argv[0]).stem)
        if not reached:
            warnings.append(missing_section_warning(source, sections, node))
        for section, values in reached.items():
            setter = source
            if source.startswith(_OVERRIDE):
                overrides.update(dict.fromkeys(values, source))
            else:
                setter = f"section '{section}' of {source}"
            kept.setdefault(section, {}).update(dict.fromkeys(values, setter))
    winners = {name: setter for values in kept.values() for name, setter in values.items()}
    for name, source in overrides.items():
        if winners[name] != source:
            raise UserError(
                f"{source} does not reach {node}, {winners[name]} overrides it: "
                "put '/**' after all other sections, and -p after all files"
            )
    return warnings


def read_parameters(path: Path, nodes: Sequence[str], namespace: str = "") -> Parameters:
    """Return the parameters that a ROS parameter file sets in nodes started together.

    Parameters
    ----------
    path : Path
        The file.
    nodes : sequence of str
        Names of the started nodes; the file may contain no others.
    namespace : str
        Namespace of the nodes.

    Returns
    -------
    dict
        Node -> parameter -> value, only for nodes in the file.

    Raises
    ------
    UserError
        For the reasons of `read_sections` and `matching_sections`, or if a section is for another
        node.
    """
    sections = read_sections(path)
    if not sections:
        raise UserError(f"{path}: not a ROS parameter file ({_FORM})")
    parameters: Parameters = {}
    for node in nodes:
        full_name = "/".join(["", *filter(None, namespace.split("/")), node])
        values = values_for(path, sections, full_name, node)
        if values is not None:
            parameters[node] = values
    for name in sections:
        if _last(name) not in (*nodes, *_WILDCARDS):
            raise UserError(f"{path}: '{name}' is not started here, only {', '.join(nodes)}")
    return parameters


def _sections(path: Path, content: Mapping[Any, Any], above: str = "") -> Iterator[Any]:
    """Yield (section, mapping below ros__parameters)."""
    for key, value in content.items():
        name = f"{above}/{key}".replace("//", "/") if above else str(key)
        # rcl compares only the beginning of the key.
        is_section = str(key).startswith(_SECTION)
        if not isinstance(value, Mapping):
            wrong = "needs NAME: VALUE pairs" if is_section else f"is outside {_SECTION}"
            raise UserError(f"{path}: '{name}' {wrong}")
        yield from [(above, value)] if is_section else _sections(path, value, name)


def _flat(values: Mapping[Any, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _unique(where: object, pairs: Iterable[tuple[str, T]]) -> dict[str, T]:
    found: dict[str, T] = {}
    for name, value in pairs:
        if name in found:
            raise UserError(f"{where}: '{name}' is a duplicate")
        found[name] = value
    return found


def _matches(section: str, node: str) -> bool:
    # Wildcards of rcl: /* matches one name, /** any number of names.
    pattern = re.escape(absolute_name(section)).replace(r"/\*", r"(/\w+)").replace(r"\*", "*")
    return re.fullmatch(pattern, node) is not None


def absolute_name(name: str) -> str:
    """Return the name of a node or topic with a leading slash."""
    return name if name.startswith("/") else f"/{name}"


def _last(name: str) -> str:
    return name.rpartition("/")[2]
