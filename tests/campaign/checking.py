"""Checks: how one is run, and what it finds."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import re
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

from needle_bringup.descendants import processes_with
from needle_core.errors import UserError
from needle_core.process.ros_domain import ports_of
from needle_core.process.shared_memory import dead_ports

T = TypeVar("T")
# Every process that a check starts carries this in its environment, so that none can hide.
MARK = "NEEDLE_VERIFICATION"


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that a step must show.

    Attributes
    ----------
    key : str
        Short name, for `--json`.
    what : str
        What is looked at.
    wanted, seen : str
        What it must be, and what it is.
    passed : bool
        Whether that is good enough.
    """

    key: str
    what: str
    wanted: str
    seen: str
    passed: bool


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
        stdout and stderr, as they came.
    bag : Path
        The folder that was asked for.
    left_over : list of str
        Processes and shared-memory ports that outlived the command.
    """

    code: int
    wall: float
    output: str
    bag: Path
    left_over: list[str]

    @property
    def summary(self) -> Mapping[str, Any]:
        """summary.json's content; empty where there is none."""
        path = self.bag / "summary.json"
        return dict(yaml.safe_load(path.read_text("utf-8"))) if path.is_file() else {}

    @property
    def last_line(self) -> str:
        """Last line of the output."""
        return ["", *self.output.strip().splitlines()][-1]


def _heed_signals() -> None:
    """Undo what a shell's background or nohup ignores, and all below would."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class StartedRun:
    """A run of `simulate` under way.

    Parameters
    ----------
    command : sequence of str
        The command line.
    bag : Path
        The bag's folder in it.
    """

    def __init__(self, command: Sequence[str], bag: Path) -> None:
        self._mark = uuid.uuid4().hex
        self._bag = bag
        self._output = bag.with_name(bag.name + ".output")
        self._begin = time.monotonic()
        with self._output.open("wb") as output:
            self.process = subprocess.Popen(
                list(command),
                env={**os.environ, MARK: self._mark},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_heed_signals,  # noqa: PLW1509
            )

    @property
    def output(self) -> str:
        """Text that it has written so far."""
        return self._output.read_text("utf-8", errors="replace")

    def wait_until_said(self, pattern: str, timeout: float = 60.0) -> re.Match[str]:
        """Wait until the run has written what this regular expression matches; return the match.

        Raises
        ------
        UserError
            If the run, or the time [s], ends before that.
        """
        deadline = time.monotonic() + timeout
        while True:
            # What it wrote last may come between the two looks: first the process, then its words.
            ended = self.process.poll() is not None
            if found := re.search(pattern, self.output):
                return found
            if ended or time.monotonic() >= deadline:
                raise UserError(f"it has not said {pattern!r}: {self.output.strip()[-500:]}")
            time.sleep(0.01)

    def interrupt(self, number: signal.Signals) -> None:
        """Send a signal as a terminal does: to the command's process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def running(self) -> list[tuple[int, str]]:
        """Return (pid, command) of every process of this run."""
        return processes_with(MARK, self._mark)

    def wait(self, timeout: float = 300.0) -> SimulateRun:
        """Wait for the end; a run that does not end is killed and has code -9."""
        try:
            code = self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        wall = time.monotonic() - self._begin
        running = self.running()
        for pid, _ in running:
            os.kill(pid, signal.SIGKILL)
        left_over = [f"{pid} {name}" for pid, name in running]
        # A domain may have new users by now.
        if domain := re.search(r"ROS_DOMAIN_ID (\d+)", self.output):
            left_over += dead_ports(ports_of(int(domain[1])))
        return SimulateRun(code, wall, self.output, self._bag, left_over)


class Workbench:
    """Place in which checks run what they look at.

    Parameters
    ----------
    command : sequence of str
        What runs `simulate`.
    folder : Path
        Takes the bags.
    """

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        self._command = list(command)
        self.folder = folder
        self._runs: dict[str, SimulateRun] = {}

    def start(self, name: str, *arguments: str) -> StartedRun:
        """Start `simulate` with these arguments and a bag of this name."""
        bag = self.folder / name
        return StartedRun([*self._command, *arguments, "--bag", str(bag)], bag)

    def run(self, name: str, *arguments: str) -> SimulateRun:
        """Run `simulate`; a name that has run before gives that run again."""
        if name not in self._runs:
            self._runs[name] = self.start(name, *arguments).wait()
        return self._runs[name]


def in_own_process(function: Callable[..., T], *arguments: object) -> T:
    """Call a function in a fresh process: it may start ROS, or move into another network."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep the processors busy with so many processes."""
    idle = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(idle) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def payloads(bag: Path, topics: Sequence[str]) -> dict[str, list[bytes]]:
    """Return the messages of some topics, as they were sent, byte for byte.

    Raises
    ------
    UserError
        If there is no bag.
    """
    found: dict[str, list[bytes]] = {topic: [] for topic in topics}
    files = list(bag.glob("*.mcap"))
    if not files:
        raise UserError(f"{bag}: there is no bag")
    with files[0].open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=list(topics)):
            found[channel.topic].append(message.data)
    return found


def unreadable(bag: Path) -> str:
    """Return why a bag does not open with rosbags and mcap; an empty text if it does."""
    try:
        with Reader(bag) as reader:
            count = sum(1 for _ in reader.messages())
            told = reader.message_count
        seen = 0
        for file in bag.glob("*.mcap"):
            with file.open("rb") as stream:
                seen += sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
    # any failure to read is what is looked for
    except Exception as error:  # noqa: BLE001
        return f"{type(error).__name__}: {error}"
    if told == count == seen:
        return ""
    return f"metadata.yaml tells of {told} messages, rosbags reads {count}, mcap {seen}"
