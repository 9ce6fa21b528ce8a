"""Step D: the device driver on emulated drives, over many steps and with killed nodes."""

from __future__ import annotations

import math
import os
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

from campaign.checking import Check, Finding, Workbench, at_most, in_own_process
from needle_device_driver.conformance.rig import FASTEST, ConformanceRig
from needle_sim.drive_emulator import COUNTS_PER_RADIAN, DriveEmulatorParameters
from scenario.faults import Fault, Kind
from scenario.process_run import PARTS, run_processes
from scenario.rig_run import RunResult

STEPS = 10_000
MOMENTS = 50
# Largest growth of memory of driver and drives in 9,000 steps [MB]: less than a byte per cycle.
MEMORY_SLACK = 2.0
_DEEPEST, _MOST_ROTATION, _STEP = 0.19, 3.0, 0.002
_COUNTS = DriveEmulatorParameters().insertion_counts_per_unit, COUNTS_PER_RADIAN


def many_steps(_: Workbench) -> Iterator[Finding]:
    """Make random steps: exact to a count, all succeed, without growth of memory."""
    off, outcomes, growth = in_own_process(random_steps, STEPS)
    what = f"{STEPS:,} random steps: the motors' place against the sum of commands"
    yield at_most("steps_position", what, 1.0, max(map(abs, off)), " counts")
    failures = [outcome for outcome in outcomes if outcome != "succeeded"]
    yield Finding(
        "steps_results",
        "results of these steps",
        "one for each, all succeeded",
        f"{len(outcomes)} results, {len(failures)} other {failures[:1]}",
        len(outcomes) == STEPS and not failures,
    )
    what = "growth of memory, from a tenth of the steps on"
    yield at_most("steps_memory", what, MEMORY_SLACK, growth, " MB")


def random_steps(count: int) -> tuple[list[float], list[str], float]:
    """Make random steps to the largest depth, retract, and repeat.

    Returns
    -------
    list of float, list of str, float
        Distance of the motors from the sum of all commands [counts], the results, and the growth of
        memory of this process [MB].
    """
    rng, rig, memory = random.Random(1), ConformanceRig(1), [0.0]
    rig.home()
    rig.press()
    at = list(rig.positions)
    for number in range(count):
        # Log-uniform from 0.01 mm.
        length = math.exp(rng.uniform(math.log(1e-5), math.log(_STEP)))
        turn = rng.uniform(-0.6, 0.6)
        turn = -turn if abs(at[1] + turn) > _MOST_ROTATION else turn
        if at[0] + length > _DEEPEST:
            rig.call("device/retract")
            rig.until(lambda: rig.hand.status.activity == "retraction", "a retraction")
            rig.until(lambda: rig.hand.status.activity == "none", "its end")
            rig.press()
            # A retraction ends at the home switch, a few counts from 0.
            at[0] = rig.positions[0]
        at = [at[0] + length, at[1] + turn]
        # Margin: rounding of the start to a count must not make the fastest step too fast.
        duration = max(length / FASTEST, abs(turn) / 3.0) * rng.uniform(1.01, 1.5)
        stamp = rig.command(at[0], at[1], duration)
        rig.until(lambda stamp=stamp: stamp in rig.hand.results, "a result")  # type: ignore[misc]
        if number in (count // 10, count - 1):
            memory.append(_memory())
    rig.runner.run(0.1)
    off = [(a - b) * c for a, b, c in zip(rig.positions, at, _COUNTS, strict=True)]
    return off, list(rig.hand.results.values()), (memory[-1] - memory[1]) / 1e6


def _memory() -> float:
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


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


CHECKS: tuple[Check, ...] = (many_steps, killed_nodes)
