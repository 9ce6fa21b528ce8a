"""Checks: how one is run, and what it finds."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from needle_bringup.descendants import processes_with, ran
from needle_core.errors import UserError
from needle_core.process.ros_domain import ports_of
from needle_core.process.shared_memory import dead_ports

# Every process that a check starts carries this in its environment, so that none can hide.
MARK = "NEEDLE_VERIFICATION"
_DOMAIN = r"ROS_DOMAIN_ID (\d+)"


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that a step must show.

    Attributes
    ----------
    key : str
        Short name, for `--json`.
    what : str
        What is looked at.
    wanted : str
        What it must be.
    seen : str
        What it is.
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
    """A finished run of `scripts/simulate`.

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
        Processes that outlived the command.
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

    def log(self, node: str) -> str:
        """Return what a node wrote."""
        path = self.bag / "logs" / f"{node}.log"
        return path.read_text("utf-8", errors="replace") if path.is_file() else ""

    @property
    def left_in_memory(self) -> list[str]:
        """Shared-memory ports that the nodes left behind; a domain may have new users by now."""
        domain = re.search(_DOMAIN, self.output)
        return dead_ports(ports_of(int(domain[1]))) if domain else []

    @property
    def last_line(self) -> str:
        """Last line of the output."""
        return ["", *self.output.strip().splitlines()][-1]


def _heed_signals() -> None:
    """Undo what a shell's background or nohup ignores, and all below would."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class StartedRun:
    """A run of `scripts/simulate` under way.

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

    def domain(self) -> int:
        """Wait until the nodes start; return their ROS_DOMAIN_ID.

        Raises
        ------
        UserError
            If the run ends, or the time, before that.
        """
        return int(self.wait_until_said(_DOMAIN)[1])

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
                how = "ended before it" if ended else f"has run {timeout:g} s and not yet"
                raise UserError(f"{how} said {pattern!r}: {self.output.strip()[-500:]}")
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
        left_over = self.running()
        for pid, _ in left_over:
            os.kill(pid, signal.SIGKILL)
        names = [f"{pid} {name}" for pid, name in left_over]
        return SimulateRun(code, wall, self.output, self._bag, names)


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


def trial_outcomes(module: str, *words: object) -> list[dict[str, Any]]:
    """Run trials in a process of their own; return what each came to.

    Parameters
    ----------
    module : str
        What runs them: it prints a JSON object for each.
    *words : object
        Its command line.

    Raises
    ------
    UserError
        If they do not end well.
    """
    command = [sys.executable, "-m", module, *map(str, words)]
    return [json.loads(line) for line in ran(command).stdout.splitlines()]


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
        reader = make_reader(stream)
        for _, channel, message in reader.iter_messages(topics=list(topics)):
            found[channel.topic].append(message.data)
    return found


def diagnostics(bag: Path) -> Iterator[tuple[int, str, str]]:
    """Yield (level, name, message) of every status on /diagnostics."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for data in payloads(bag, ["/diagnostics"])["/diagnostics"]:
        array: Any = store.deserialize_cdr(data, "diagnostic_msgs/msg/DiagnosticArray")
        for status in array.status:
            yield int(status.level), str(status.name), str(status.message)


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
