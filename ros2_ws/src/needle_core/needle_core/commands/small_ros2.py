"""A small `ros2` for environments without ROS 2's own command line: PyPI has none.

It has what the documents of this project use, in the syntax of the real one.
`needle_core.ros.graph_commands` has the commands that need a graph.
"""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import NoReturn

from needle_core.errors import UserError
from needle_core.process.discovery import clean_environment

HELP = """\
usage: ros2 run PACKAGE EXECUTABLE [arguments]
       ros2 pkg executables [PACKAGE]
       ros2 node list
       ros2 topic list | echo TOPIC | pub TOPIC TYPE [YAML]
       ros2 service call SERVICE TYPE [YAML]
       ros2 param get NODE NAME | set NODE NAME VALUE

This is a small stand-in: PyPI has no ros2 command line. It runs the nodes and tools of this
project and speaks to a running graph; `ros2 topic pub --help` and the like say more. For
everything else (bag, launch, ...) install ROS 2 Jazzy, source it and run scripts/setup again.
"""
_MODULE = ".executables"


def main() -> int:
    """Do what the command line says; returns the exit code."""
    try:
        match sys.argv[1:]:
            case ["run", package, executable, *rest]:
                run(package, executable, rest)
            case ["pkg", "executables", *given]:
                for package in given or sorted(executables()):
                    print("\n".join(f"{package} {name}" for name in of_package(package)))
            case ["node" | "topic" | "service" | "param", *_] as words:
                clean_environment()
                commands = importlib.import_module("needle_core.ros.graph_commands")
                return int(commands.main(words))
            case words:
                print(HELP, end="")
                return 0 if words in ([], ["-h"], ["--help"]) else 2
    except UserError as error:
        print(f"ros2: {error}", file=sys.stderr)
        return 2
    return 0


def executables() -> dict[str, dict[str, EntryPoint]]:
    """Return the installed executables for `ros2 run`, by package and name."""
    found: dict[str, dict[str, EntryPoint]] = {}
    for one in sorted(entry_points(group="console_scripts"), key=lambda point: point.name):
        if one.module.endswith(_MODULE):
            found.setdefault(one.module.removesuffix(_MODULE), {})[one.name] = one
    return found


def of_package(package: str) -> dict[str, EntryPoint]:
    """Return a package's executables by name.

    Raises
    ------
    UserError
        If there is no such package.
    """
    found = executables()
    if package not in found:
        raise UserError(f"package '{package}' not found{suggest(package, found)}")
    return found[package]


def run(package: str, executable: str, arguments: list[str]) -> NoReturn:
    """Run an executable in this process: signals reach it, and its exit code is that of `ros2`.

    Raises
    ------
    UserError
        If there is no such package or executable.
    """
    found = of_package(package)
    if executable not in found:
        hint = suggest(executable, found)
        raise UserError(f"package '{package}' has no executable '{executable}'{hint}")
    sys.argv = [executable, *arguments]
    sys.exit(found[executable].load()())


def suggest(name: str, known: Iterable[str]) -> str:
    """Return a hint at what may have been meant."""
    close = difflib.get_close_matches(name, known, n=3)
    if close:
        return f"; did you mean {' or '.join(close)}?"
    return f"; there is {', '.join(sorted(known))}"
