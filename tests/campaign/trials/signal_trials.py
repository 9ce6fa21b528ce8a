"""Signals to all nodes at once, at random moments of a run in real time at 2 x 30 Hz."""

from __future__ import annotations

import contextlib
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from campaign.checking import bag_read_error, busy
from campaign.trials.trial_processes import TrialProcesses
from needle_bringup.simulation.node_graph import NodeProcess
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.errors import UserError
from needle_core.process.ros_domain import reserve_domain_id

# Latest signal, in the middle of the insertion [s].
_LATEST = 12.0
_START_UP, _SECOND_WITHIN, _HANGS, _POLL = 60.0, 0.3, 20.0, 0.005
_KINDS = ("SIGINT", "SIGINT twice", "SIGTERM", "SIGHUP")
_WRONG = ("Traceback", "Exception ignored", "terminate called", "Fatal Python error")


class Ended(NamedTuple):
    """End of one node.

    Attributes
    ----------
    node : str
        Its name.
    when : str
        Signal, and its time after the start of all nodes.
    seconds : float
        From the (first) signal to the end [s].
    wrong : str
        Error of the end: exit code, forbidden output, or why the recorder's bag cannot be read;
        empty if there is none.
    """

    node: str
    when: str
    seconds: float
    wrong: str


def signal_trials(folder: Path, count: int, burners: int) -> Iterator[Ended]:
    """Yield the end of each node of `count` graphs, one after the other.

    Parameters
    ----------
    folder : Path
        For a folder of each graph.
    count : int
        Number of graphs.
    burners : int
        Number of processes that load the CPU; also the seed.
    """
    rng = random.Random(burners)
    with busy(burners):
        for number in range(count):
            place = folder / f"signals_{number}"
            place.mkdir()
            kind, moment = _KINDS[number % len(_KINDS)], rng.uniform(0.0, _LATEST)
            with reserve_domain_id() as domain:
                yield from _trial(place, domain, kind, moment, rng)


def _trial(
    folder: Path, domain: int, kind: str, moment: float, rng: random.Random
) -> Iterator[Ended]:
    options = SimulateOptions(level="drive", graph=True, seed=rng.randrange(1000))
    bag = folder / "bag"
    parameters = command_line_parameters(options, bag)
    parameters["sim_rig"]["camera_rate"] = 30.0
    with contextlib.closing(TrialProcesses(folder, domain, parameters)) as graph:
        nodes = list(graph.nodes.values())
        # A node that does not catch SIGTERM yet is still starting.
        deadline = time.monotonic() + _START_UP
        while not all(_catches(node.pid, signal.SIGTERM) for node in nodes):
            if time.monotonic() > deadline:
                raise UserError("; ".join(node.describe_end() for node in nodes))
            time.sleep(_POLL)
        time.sleep(moment)
        number, sent_at = signal.Signals[kind.split(maxsplit=1)[0]], time.monotonic()
        # As a terminal does, no node observes another's end before its own signal. All are stopped
        # meanwhile, because a signalled node could delay the sender.
        for each in (signal.SIGSTOP, number, signal.SIGCONT):
            _send(nodes, each)
        if kind.endswith("twice"):
            time.sleep(rng.uniform(0.0, _SECOND_WITHIN))
            _send(nodes, number)
        ends: dict[str, float] = {}
        while len(ends) < len(nodes) and time.monotonic() < sent_at + _HANGS:
            for node in nodes:
                if node.exit_code is not None and node.name not in ends:
                    ends[node.name] = time.monotonic() - sent_at
            time.sleep(_POLL)
        for node in nodes:
            wrong = _wrong(node)
            if node.name == "recorder" and bag.exists():
                wrong = wrong or bag_read_error(bag)
            yield Ended(node.name, f"{kind} at {moment:.1f} s", ends.get(node.name, _HANGS), wrong)


def _catches(pid: int, number: signal.Signals) -> bool:
    status = Path(f"/proc/{pid}/status").read_text("ascii", "replace")
    caught = status.partition("SigCgt:")[2].split(maxsplit=1)
    return bool(caught) and bool(int(caught[0], 16) >> (number - 1) & 1)


def _send(nodes: list[NodeProcess], number: signal.Signals) -> None:
    for node in nodes:
        node.signal_group(number)


def _wrong(node: NodeProcess) -> str:
    if node.exit_code not in (0, 130):
        return node.describe_end()
    output = node.log.read_text("utf-8", "replace")
    return next((f"it printed {word!r}" for word in _WRONG if word in output), "")
