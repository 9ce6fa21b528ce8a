"""Small `ros2` for environments without ROS 2's own command line, which PyPI does not have.

It contains the verbs of this project's documents, in the syntax of the original.
`needle_core.ros.graph_commands` contains the verbs that need a graph.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from needle_core.errors import UserError, did_you_mean
from needle_core.process.discovery import clean_environment

HELP = """\
usage: ros2 run PACKAGE EXECUTABLE [arguments]
       ros2 pkg executables [PACKAGE]
       ros2 {node list,topic list,topic echo,topic pub,service call,param get,param set} --help

A small substitute for the ros2 command line, which PyPI does not have; options: `--help`.
For everything else (bag, launch, ...) install ROS 2 Jazzy, source it and run scripts/setup again.
"""
_MODULE = ".executables"
T = TypeVar("T")


def main() -> int:
    """Run the command line; return the exit code."""
    try:
        match sys.argv[1:]:
            case ["run", package, executable, *arguments]:
                found = _find("package", package, _executables())
                entry = _find(f"executable of {package}", executable, found)
                # Run it in this process, so that it receives signals and sets the exit code.
                sys.argv = [executable, *arguments]
                sys.exit(entry.load()())
            case ["pkg", "executables", *given]:
                for package in given or sorted(_executables()):
                    for name in _find("package", package, _executables()):
                        print(package, name)
            case ["node" | "topic" | "service" | "param", *_] as arguments:
                clean_environment()
                commands = importlib.import_module("needle_core.ros.graph_commands")
                return int(commands.main(arguments))
            case arguments:
                print(HELP, end="")
                return 0 if arguments in ([], ["-h"], ["--help"]) else 2
    except UserError as error:
        print(f"ros2: {error}", file=sys.stderr)
        return 2
    return 0


def _executables() -> dict[str, dict[str, EntryPoint]]:
    """Return the installed executables by package and name."""
    found: dict[str, dict[str, EntryPoint]] = {}
    for one in sorted(entry_points(group="console_scripts"), key=lambda point: point.name):
        if one.module.endswith(_MODULE):
            found.setdefault(one.module.removesuffix(_MODULE), {})[one.name] = one
    return found


def _find(kind: str, name: str, known: Mapping[str, T]) -> T:
    """Return a known package or executable; raise a `UserError` with a suggestion otherwise."""
    if name in known:
        return known[name]
    raise UserError(f"{kind} '{name}' not found ({did_you_mean(name, known)})")
