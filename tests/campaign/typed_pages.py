"""Executes the code blocks of the pages, verbatim and in order, and reports failures.

    python tests/campaign/typed_pages.py [PAGE ...]       # in a fresh clone, at full length

Code blocks that are indented, or fenced as `sh`, are commands; `python` is a program; `yaml NAME`,
`toml NAME` and `python NAME` are files of that name; `text` is not typed. A process that runs until
Ctrl-C runs until the page's end, or `<!-- Ctrl-C -->`. `<!-- not typed: WHY -->` before a block
leaves it out.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).resolve().parents[2]
PAGES = (
    "docs/get_started.md", "README.md", "bags/README.md", "docs/hardware.md", "docs/calibration.md",
    "docs/own_controllers.md", "docs/own_drives.md", "docs/drive_galil.md", "docs/drive_zaber.md",
    "docs/drive_stepdir.md", "docs/examples/README.md", "docs/own_rig.md",
    "docs/troubleshooting.md",
)  # fmt: skip
COMMAND, PROGRAM, FILE = "command", "python", "file"
FILES = ("yaml", "toml", "python")
NOT_TYPED = ("text",)
# Executables that run until Ctrl-C; others do so with `--loop`.
NODES = (
    "sim_rig", "stereo_tracker", "plane_controller", "recorder", "device_driver", "drive_emulator",
    "stereo_camera", "operator", "live_view",
)  # fmt: skip
# Left out, because it runs these blocks itself.
LEFT_OUT = ("scripts/test",)
# Time-outs of a command, of a node's start or a service's success, and of a node's exit [s].
LIMIT = 600.0
READY = 60.0
ENDS = 40.0
INTERRUPTED = 130
# Period of the check that nodes are alive [s].
START_CHECK_TIME = 1.0


@dataclasses.dataclass(frozen=True)
class Block:
    """A block of a page.

    Attributes
    ----------
    line : int
        First line in the page, from 1.
    kind : str
        COMMAND, PROGRAM or FILE.
    text : str
        Its text.
    name : str
        Name of a FILE.
    ends_nodes : bool
        Whether Ctrl-C is pressed before it.
    """

    line: int
    kind: str
    text: str
    name: str = ""
    ends_nodes: bool = False


class PageError(Exception):
    """A block that fails."""


def blocks(page: str) -> list[Block]:
    """Return the blocks of a page, in order.

    Raises
    ------
    PageError
        For a fence of an unknown kind, or a file without a name.
    """
    found = []
    marks: list[str] = []
    pattern = re.compile(
        r"^(?P<indent> *)```(?P<info>.*)\n(?P<fenced>(?:.*\n)*?) *```$"
        r"|^<!-- (?P<mark>.+?) -->$"
        r"|(?<=\n\n)(?P<indented>(?:    .*\n+)+)",
        re.MULTILINE,
    )
    for match in pattern.finditer(page):
        if match["mark"]:
            marks.append(match["mark"])
            continue
        line = page.count("\n", 0, match.start()) + 1
        kind, _, name = (match["info"] or "sh").partition(" ")
        text = textwrap.dedent(match["fenced"] or match["indented"] or "").strip("\n")
        left_out = any(mark.startswith("not typed: ") for mark in marks)
        ends_nodes = "Ctrl-C" in marks
        marks.clear()
        if left_out or kind in NOT_TYPED:
            continue
        known = dict.fromkeys(FILES, FILE) if name else {"sh": COMMAND, "python": PROGRAM}
        if kind not in known:
            raise PageError(f"line {line}: a block of kind '{kind} {name}' cannot be typed")
        found.append(Block(line, known[kind], text, name, ends_nodes))
    return found


def commands(text: str) -> list[str]:
    """Return the commands of a block; a command may span several lines."""
    found: list[str] = []
    for line in text.replace("\\\n", " ").splitlines():
        if found and found[-1].count('"') % 2:
            found[-1] += f"\n{line}"
        elif line.strip():
            found.append(line)
    return found


class Session:
    """A user who types the blocks of a page.

    Parameters
    ----------
    folder : Path
        The checkout, or a copy.
    environment : mapping
        Environment of the commands.
    log : callable
        Called with each command before it runs.
    change : callable, optional
        Changes a command before it runs, for shorter tests.

    Attributes
    ----------
    said : list of str
        Output of each command.
    """

    def __init__(
        self,
        folder: Path,
        environment: Mapping[str, str],
        log: Callable[[str], None],
        change: Callable[[str], str] = str,
    ) -> None:
        self._folder = folder
        self._environment = dict(environment)
        self._log = log
        self._change = change
        self._nodes: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}
        self._logs = Path()
        self.outputs: list[str] = []

    def type(self, page: Path) -> None:
        """Type a page, then end its nodes.

        Raises
        ------
        PageError
            At the first block that fails.
        """
        found = blocks(page.read_text("utf-8"))
        for block in found:
            if block.kind == FILE:
                file = self._folder / block.name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(f"{block.text}\n", encoding="utf-8")
        with tempfile.TemporaryDirectory(prefix="typed_") as logs:
            self._logs = Path(logs)
            self._type_blocks(page, found)

    def _type_blocks(self, page: Path, found: list[Block]) -> None:
        try:
            for block in found:
                try:
                    self._type_block(block)
                except PageError as error:
                    raise PageError(f"{page}:{block.line}: {error}") from error
            self.end_nodes()
        finally:
            for process, _ in self._nodes.values():
                process.kill()
                process.wait()

    def _type_block(self, block: Block) -> None:
        if block.ends_nodes:
            self.end_nodes()
        if block.kind == PROGRAM:
            self._run(shlex.join(["python", "-c", block.text]))
        elif block.kind == COMMAND and re.search(r"&$", block.text, re.MULTILINE):
            self._run(block.text)
        elif block.kind == COMMAND:
            for command in commands(block.text):
                self._type_command(command)

    def _type_command(self, command: str) -> None:
        words = shlex.split(command, comments=True)
        if not words or words[0] in LEFT_OUT:
            return
        runs = words[:2] == ["ros2", "run"] and "--help" not in words
        if runs and (words[3] in NODES or "--loop" in words):
            self._start_node(words[3], command)
            return
        text = self._run(command)
        end = time.monotonic() + READY
        while "success=False" in text:
            if time.monotonic() > end:
                raise PageError(f"{command}\n{text}")
            text = self._run(command)

    def _open(self, command: str, stdin: int, output: IO[Any]) -> subprocess.Popen[bytes]:
        """Start a command in a shell with the environment of this checkout."""
        self._log(command)
        before = "" if "scripts/setup" in command else "source scripts/env.sh\n"
        return subprocess.Popen(
            ["bash", "-c", f"{before}{command}"],
            cwd=self._folder,
            env=self._environment,
            stdin=stdin,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def _run(self, command: str) -> str:
        command = self._change(command)
        expected = re.search(r"exit code (\d+)", command)
        with tempfile.TemporaryFile("w+") as output:
            process = self._open(command, subprocess.DEVNULL, output)
            try:
                code = self._end_of(process, command)
            except BaseException:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                raise
            output.seek(0)
            text = output.read()
        self.outputs.append(text)
        if code != int(expected[1] if expected else 0):
            raise PageError(f"{command}\nends with {code}: {text}")
        return text

    def _end_of(self, process: subprocess.Popen[bytes], command: str) -> int:
        """Return the exit code of a command; the nodes must run until then."""
        end = time.monotonic() + LIMIT
        while True:
            with contextlib.suppress(subprocess.TimeoutExpired):
                return process.wait(START_CHECK_TIME)
            for name, (node, log) in self._nodes.items():
                if node.poll() is not None:
                    raise PageError(f"{command}\n{name} has ended: {log.read_text('utf-8')}")
            if time.monotonic() > end:
                raise PageError(f"{command}\ndoes not end")

    def _start_node(self, name: str, command: str) -> None:
        log = self._logs / name
        with log.open("wb") as output:
            # exec: a background job of a shell without job control ignores SIGINT.
            process = self._open(f"exec {self._change(command)}", subprocess.PIPE, output)
        self._nodes[name] = process, log
        end = time.monotonic() + READY
        listing = ["bash", "-c", "source scripts/env.sh; ros2 node list"]
        while f"/{name}" not in self._ask(listing).split():
            if process.poll() is not None or time.monotonic() > end:
                raise PageError(f"{command}\ndoes not start: {log.read_text('utf-8')}")

    def _ask(self, shell: list[str]) -> str:
        return subprocess.run(
            shell,
            check=False,
            cwd=self._folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=READY,
        ).stdout

    def end_nodes(self) -> None:
        """Press Ctrl-C in every terminal.

        Raises
        ------
        PageError
            If a node does not end, ended before, or printed a traceback.
        """
        for name, (process, log) in list(self._nodes.items()):
            if process.poll() is not None:
                raise PageError(f"{name} has ended unexpectedly: {log.read_text('utf-8')}")
            process.send_signal(signal.SIGINT)
        for name, (process, log) in list(self._nodes.items()):
            try:
                code = process.wait(ENDS)
            except subprocess.TimeoutExpired as error:
                raise PageError(f"{name} does not end on Ctrl-C") from error
            assert process.stdin is not None
            process.stdin.close()
            text = log.read_text("utf-8")
            if code not in (0, 130) or "Traceback" in text:
                raise PageError(f"{name} ends with {code}: {text}")
            del self._nodes[name]


@contextlib.contextmanager
def fresh_clone() -> Iterator[Path]:
    """Yield a temporary clone of the last commit."""
    with tempfile.TemporaryDirectory(prefix="needle_clone_") as folder:
        clone = Path(folder) / "needle"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        yield clone


def main(pages: list[str]) -> int:
    """Type pages in a fresh clone; return 1 if a page fails, 130 on an interrupt."""
    try:
        return _type_all(pages)
    except KeyboardInterrupt:
        return INTERRUPTED


def _type_all(pages: list[str]) -> int:
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "AMENT_PREFIX_PATH", "VIRTUAL_ENV")
    }
    failed = 0
    with fresh_clone() as clone:
        for page in pages or PAGES:
            print(f"== {page}", flush=True)
            try:
                Session(clone, environment, lambda line: print(f"$ {line}", flush=True)).type(
                    clone / page
                )
            except PageError as error:
                print(f"FAILED {error}", flush=True)
                failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
