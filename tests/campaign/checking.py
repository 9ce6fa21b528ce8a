"""Runs of `simulate` for the checks of `scripts/verify`, and their findings."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from child_processes import processes_with

T = TypeVar("T")
# Environment variable that marks every process of a check.
MARK = "NEEDLE_VERIFICATION"


@dataclasses.dataclass(frozen=True)
class Finding:
    """A required figure and the measured one.

    Attributes
    ----------
    key : str
        Short name, for `--json`.
    what : str
        Description of the figure.
    required, measured : str
        Required and measured value, as text.
    passed : bool
        Whether the measured value meets the requirement.
    """

    key: str
    what: str
    required: str
    measured: str
    passed: bool


def at_least(
    key: str, what: str, bound: float, value: float, unit: str = "", form: str = ".4g"
) -> Finding:
    """Return a finding that passes if a value reaches a bound; both are shown in a format."""
    required, measured = (f"{number:{form}}{unit}" for number in (bound, value))
    return Finding(key, what, f">= {required}", measured, value >= bound)


def at_most(
    key: str, what: str, bound: float, value: float, unit: str = "", form: str = ".4g"
) -> Finding:
    """Return a finding that passes if a value does not exceed a bound; see `at_least`."""
    required, measured = (f"{number:{form}}{unit}" for number in (bound, value))
    return Finding(key, what, f"<= {required}", measured, value <= bound)


Check = Callable[["Workbench"], Iterator[Finding]]


@dataclasses.dataclass(frozen=True)
class SimulateRun:
    """A finished run of `simulate`.

    Attributes
    ----------
    code : int
        Exit code.
    wall : float
        Time from the command to its end [s].
    output : str
        stdout and stderr.
    bag : Path
        Folder of the run.
    left_over : list of str
        Processes that outlived the command.
    """

    code: int
    wall: float
    output: str
    bag: Path
    left_over: list[str]

    @property
    def summary(self) -> Mapping[str, Any]:
        """Content of summary.json; empty if there is none."""
        path = self.bag / "summary.json"
        return dict(yaml.safe_load(path.read_text("utf-8"))) if path.is_file() else {}

    @property
    def last_line(self) -> str:
        """Last line of the output."""
        return ["", *self.output.strip().splitlines()][-1]


class Workbench:
    """Folder in which checks run `simulate`.

    Parameters
    ----------
    command : sequence of str
        Command of `simulate`.
    folder : Path
        Folder of the bags.
    """

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        self._command = list(command)
        self.folder = folder
        self._runs: dict[str, SimulateRun] = {}

    def run(self, name: str, *arguments: str) -> SimulateRun:
        """Run `simulate`, or return the earlier run of the same name."""
        if name not in self._runs:
            self._runs[name] = self._run(self.folder / name, arguments)
        return self._runs[name]

    def _run(self, bag: Path, arguments: Sequence[str]) -> SimulateRun:
        mark, begin = uuid.uuid4().hex, time.monotonic()
        log = bag.with_name(bag.name + ".output")
        # Write to a file: a leftover process would keep a pipe open.
        with log.open("wb") as output:
            done = subprocess.run(
                [*self._command, *arguments, "--bag", str(bag)],
                env={**os.environ, MARK: mark},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
            )
        wall = time.monotonic() - begin
        running = processes_with(MARK, mark)
        for pid, _ in running:
            os.kill(pid, signal.SIGKILL)
        left_over = [f"{pid} {name}" for pid, name in running]
        text = log.read_text("utf-8", "replace")
        return SimulateRun(done.returncode, wall, text, bag, left_over)


def in_own_process(function: Callable[..., T], *arguments: object) -> T:
    """Call a function in a new process, in which it may start ROS or enter another network."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Load the CPU with a number of processes."""
    idle = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(idle) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def bag_read_error(bag: Path) -> str:
    """Return why rosbags or mcap cannot read a bag; empty if they can."""
    try:
        with Reader(bag) as reader:
            count = sum(1 for _ in reader.messages())
            reported = reader.message_count
        measured = 0
        for file in bag.glob("*.mcap"):
            with file.open("rb") as stream:
                measured += sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
    # Any error is a finding.
    except Exception as error:  # noqa: BLE001
        return f"{type(error).__name__}: {error}"
    if reported == count == measured:
        return ""
    return f"metadata.yaml reports {reported} messages, rosbags reads {count}, mcap {measured}"
