"""Step D: an insertion on emulated drives, during which a node is killed."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

from campaign.checking import Check, Finding, Workbench, in_own_process
from scenario.faults import Fault, Kind
from scenario.process_run import PARTS, run_processes
from scenario.rig_run import RunResult

MOMENTS = 50


def killed_nodes(_: Workbench) -> Iterator[Finding]:
    """Kill each node of the graph: motion ends within its bound, and continues on command."""
    rng = random.Random(4)
    for node in PARTS:
        ends = [in_own_process(_kill, n, node, rng.uniform(0.0, 2.0)) for n in range(MOMENTS)]
        texts = [f"{one.invariant}: {one.text}" for result in ends for one in result.violations]
        yield Finding(
            f"killed_{node}",
            f"kill -9 of {node} at {MOMENTS} moments of an insertion in real time",
            "no motion beyond the command and the hold, none without a command; it continues",
            f"{len(texts)} violations {texts[:2]}",
            not texts,
        )


def _kill(seed: int, node: str, at: float) -> RunResult:
    with tempfile.TemporaryDirectory(prefix="needle_trial_") as name:
        return run_processes(seed, Path(name), [Fault(node, Kind.OFF, at, 3.0, 0.0)])


CHECKS: tuple[Check, ...] = (killed_nodes,)
