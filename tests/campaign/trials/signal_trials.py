"""Signals to every node at once, at random moments of a run in real time at 2 x 30 Hz."""

from __future__ import annotations

import contextlib
import dataclasses
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path

from campaign.checking import unreadable
from campaign.trials.trial_processes import TrialProcesses
from needle_bringup.descendants import busy
from needle_bringup.simulation.node_process import NodeProcess
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.errors import UserError
from needle_core.process.ros_domain import own_domain

# From the start-up to the middle of the insertion [s].
LATEST = 12.0
_START_UP = 60.0
_SECOND_WITHIN = 0.3
_HANGS = 20.0
_POLL = 0.005
_KINDS = ("SIGINT", "SIGINT twice", "SIGTERM", "SIGHUP")
_WRONG = ("Traceback", "Exception ignored", "terminate called", "Fatal Python error")


@dataclasses.dataclass(frozen=True)
class Ended:
    """End of one node.

    Attributes
    ----------
    node : str
        Its name.
    kind : str
        What was sent, `SIGINT twice` within 0.3 s.
    moment : float
        When: after all nodes had begun [s].
    seconds : float
        From the (first) signal to the end [s]; infinite where it had to be killed.
    code : int
        Exit code.
    wrong : str
        What it wrote that no node must write, or why the recorder's bag cannot be read.
    said : str
        The last line that it wrote.
    """

    node: str
    kind: str
    moment: float
    seconds: float
    code: int
    wrong: str
    said: str

    @property
    def description(self) -> str:
        """Node, time and signal in words."""
        return f"{self.node} {self.seconds:.2f} s after {self.kind} at {self.moment:.1f} s"


def signal_trials(
    folder: Path, count: int, seed: int, *, burners: int = 0, latest: float = LATEST
) -> Iterator[Ended]:
    """Yield how each node ended, from `count` graphs one after the other.

    Parameters
    ----------
    folder : Path
        Takes a folder for each graph.
    count : int
        Graphs.
    seed : int
        Of moments, kinds and simulations.
    burners : int
        Processes that keep the cores busy meanwhile.
    latest : float
        Latest moment [s].
    """
    rng = random.Random(seed)
    with busy(burners):
        for number in range(count):
            place = folder / f"signals_{number}"
            place.mkdir()
            kind, moment = _KINDS[number % len(_KINDS)], rng.uniform(0.0, latest)
            with own_domain() as domain:
                yield from _trial(place, domain, kind, moment, rng)


def _trial(
    folder: Path, domain: int, kind: str, moment: float, rng: random.Random
) -> Iterator[Ended]:
    options = SimulateOptions(level="drive", graph=True, seed=rng.randrange(1000))
    bag = folder / "bag"
    parameters = command_line_parameters(options, bag)
    parameters["sim_rig"]["camera_rate"] = 30.0
    with contextlib.closing(TrialProcesses(folder, domain, parameters)) as graph:
        nodes = list(graph.processes.values())
        _wait_until_begun(nodes)
        time.sleep(moment)
        number = signal.Signals[kind.split(maxsplit=1)[0]]
        sent_at = time.monotonic()
        _send_at_once(nodes, number)
        if kind.endswith("twice"):
            time.sleep(rng.uniform(0.0, _SECOND_WITHIN))
            # All have the first: none needs to be stopped for the second.
            _send(nodes, number)
        ends = _ends(nodes)
        for node in nodes:
            ended_at, code = ends.get(node.name, (float("inf"), -signal.SIGKILL))
            wrong = _wrong(node)
            if node.name == "recorder" and bag.exists():
                wrong = wrong or unreadable(bag)
            yield Ended(node.name, kind, moment, ended_at - sent_at, code, wrong, node.last_line)


def _wait_until_begun(nodes: list[NodeProcess]) -> None:
    """Wait until each catches SIGTERM: before, it is no more than Python's interpreter."""
    end = time.monotonic() + _START_UP
    while not all(_catches(node.pid, signal.SIGTERM) for node in nodes):
        if time.monotonic() > end or any(node.exit_code is not None for node in nodes):
            raise UserError("; ".join(node.describe_end() for node in nodes))
        time.sleep(_POLL)


def _catches(pid: int, number: signal.Signals) -> bool:
    for line in Path(f"/proc/{pid}/status").read_text("ascii", "replace").splitlines():
        if line.startswith("SigCgt:"):
            return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


def _send_at_once(nodes: list[NodeProcess], number: signal.Signals) -> None:
    """Send a signal as a terminal does: none sees another's end before it has the signal itself.

    They are stopped meanwhile: each that gets it may take the processor from who sends it.
    """
    _send(nodes, signal.SIGSTOP)
    _send(nodes, number)
    _send(nodes, signal.SIGCONT)


def _send(nodes: list[NodeProcess], number: signal.Signals) -> None:
    for node in nodes:
        node.signal_group(number)


def _ends(nodes: list[NodeProcess]) -> dict[str, tuple[float, int]]:
    """Wait for the ends; return when each came, and with which exit code."""
    ends: dict[str, tuple[float, int]] = {}
    limit = time.monotonic() + _HANGS
    while len(ends) < len(nodes) and time.monotonic() < limit:
        for node in nodes:
            code = node.exit_code
            if code is not None and node.name not in ends:
                ends[node.name] = time.monotonic(), code
        time.sleep(_POLL)
    return ends


def _wrong(node: NodeProcess) -> str:
    said = node.log.read_text("utf-8", "replace")
    return next((f"{node.name} said {word!r}" for word in _WRONG if word in said), "")
