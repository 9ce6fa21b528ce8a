"""A small `ros2` for environments without ROS 2's own command line (there is none on PyPI).

It knows what the documents of this project use, with the syntax, the output and the exit codes of
the real one. scripts/setup puts it into the virtual environment. This file uses the standard
library only, so that `ros2 run` costs no time; ros2_graph.py speaks to a running graph.
"""

from __future__ import annotations

import difflib
import os
import signal
import sys
from pathlib import Path
from typing import NoReturn

HELP = """\
usage: ros2 run PACKAGE EXECUTABLE [arguments]
       ros2 pkg executables [PACKAGE]
       ros2 node list
       ros2 topic list | echo TOPIC | hz TOPIC | pub TOPIC TYPE [YAML]
       ros2 service list | call SERVICE TYPE [YAML]
       ros2 param list [NODE] | get NODE NAME | set NODE NAME VALUE

This is a small stand-in that scripts/setup installed: PyPI has no ros2 command line. It runs the
nodes and tools of this workspace and speaks to a running graph; `ros2 topic pub --help` and the
like say more. For everything else (bag, launch, ...) install ROS 2 Jazzy, source it and run
scripts/setup again.
"""
GRAPH_COMMANDS = ("topic", "service", "param", "node")


def fail(code: int, text: str) -> NoReturn:
    """Print one line and end."""
    print(f"ros2: {text}", file=sys.stderr)
    sys.exit(code)


def prefixes() -> dict[str, Path]:
    """Return the sourced packages and where they are installed, nearest first."""
    found: dict[str, Path] = {}
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        index = Path(prefix, "share", "ament_index", "resource_index", "packages")
        if index.is_dir():
            for marker in index.iterdir():
                found.setdefault(marker.name, Path(prefix))
    if not found:
        fail(1, "no packages found: source scripts/env.sh first")
    return found


def executables(package: str, prefix: Path) -> dict[str, Path]:
    """Return a package's executables by name."""
    folder = prefix / "lib" / package
    if not folder.is_dir():
        return {}
    return {
        path.name: path
        for path in sorted(folder.iterdir())
        if path.is_file() and os.access(path, os.X_OK)
    }


def suggest(name: str, known: list[str]) -> str:
    """Return a hint at what may have been meant."""
    close = difflib.get_close_matches(name, known, n=3)
    if close:
        return f"; did you mean {' or '.join(close)}?"
    return f"; there is {', '.join(sorted(known))}" if known else ""


def for_users(found: dict[str, Path]) -> dict[str, Path]:
    """Return the packages with executables that a person runs.

    Those of the virtual environment itself are ROS 2's generators of message code.
    """
    environment = Path(sys.executable).parents[1].resolve()
    return {
        name: prefix
        for name, prefix in found.items()
        if prefix.resolve() != environment and executables(name, prefix)
    }


def find_package(package: str) -> Path:
    """Return where a package is installed; ends with a hint where it is not."""
    found = prefixes()
    if package not in found:
        fail(1, f"package '{package}' not found{suggest(package, list(for_users(found)))}")
    return found[package]


def run(package: str, executable: str, arguments: list[str]) -> NoReturn:
    """Become the executable: signals reach it and its exit code is ours."""
    found = executables(package, find_package(package))
    if executable not in found:
        hint = suggest(executable, list(found)) or " (it has none)"
        fail(1, f"package '{package}' has no executable '{executable}'{hint}")
    path = str(found[executable])
    with Path(path).open("rb") as file:
        script = file.read(2) == b"#!" and b"python" in file.readline() + file.readline()
    # Python ignores SIGPIPE, and what it becomes would inherit that.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    sys.stdout.flush()
    try:
        # Through the interpreter, as a first line cannot name one in a path with a space.
        if script:
            os.execv(sys.executable, [sys.executable, path, *arguments])
        os.execv(path, [path, *arguments])
    except OSError as error:
        fail(1, f"cannot run {path}: {error.strerror}")


def speak_to_graph(arguments: list[str]) -> NoReturn:
    """Become ros2_graph.py, with the packages that this interpreter was started without."""
    if not os.environ.get("AMENT_PREFIX_PATH"):
        fail(1, "no packages found: source scripts/env.sh first")
    sys.path.insert(0, str(Path(__file__).parents[2] / "ros2_ws" / "src" / "needle_core"))
    from needle_core.errors import UserError  # noqa: PLC0415
    from needle_core.process.reach import settle_environment  # noqa: PLC0415

    try:
        settle_environment()
    except UserError as error:
        fail(2, str(error))
    script = str(Path(__file__).with_name("ros2_graph.py"))
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, script, *arguments])


def list_executables(package: str | None) -> int:
    """Print `package executable` lines, of all packages or of one."""
    found = for_users(prefixes()) if package is None else {package: find_package(package)}
    for name, prefix in sorted(found.items()):
        for executable in executables(name, prefix):
            print(f"{name} {executable}")
    return 0


def main(arguments: list[str]) -> int:
    """Do what the command line says."""
    match arguments:
        case [] | ["-h" | "--help", *_] | ["run" | "pkg", "-h" | "--help", *_]:
            print(HELP, end="")
            return 0
        case ["run", package, executable, *rest]:
            run(package, executable, rest)
        case ["run", *_]:
            fail(2, "usage: ros2 run PACKAGE EXECUTABLE [arguments]")
        case ["pkg", "executables", "-h" | "--help"]:
            print(HELP, end="")
            return 0
        case ["pkg", "executables"]:
            return list_executables(None)
        case ["pkg", "executables", package]:
            return list_executables(package)
        case [command, *_] if command in GRAPH_COMMANDS:
            speak_to_graph(arguments)
        case [command, *_]:
            fail(
                2,
                f"this stand-in knows only run, pkg executables, {', '.join(GRAPH_COMMANDS)}; "
                f"`ros2 {command}` needs an installed ROS 2 Jazzy (ros2 --help)",
            )
    return 2


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    sys.exit(main(sys.argv[1:]))
