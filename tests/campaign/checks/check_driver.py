"""Step D: the device driver on emulated drives: exact, repeatable, never an unbounded motion."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from campaign.checking import Check, Finding, Workbench, in_own_process
from campaign.trials.drive_trials import FAULTS, fault_trials, random_steps
from scenario.faults import Fault, Kind
from scenario.process_run import PARTS, run_processes
from scenario.rig_run import RunResult

STEPS = 10_000
MOMENTS = 50
# What the memory of driver and drives may grow by in 9,000 steps [MB]: less than a byte a cycle.
MEMORY_SLACK = 2.0
# docs/safety.md, of a motion that goes on at its speed: for so long [s], and what comes on top [m].
# A drive ends at the last set-point by itself: at most the one sent and the one under way. The
# other drive gets no set-point more once one has left a SYNC unanswered.
_BY_ITSELF, _SILENT, _TOLD = (0.04, 5e-6), (0.08, 5e-5), (0.07, 5e-5)
BOUNDS = {
    **dict.fromkeys(("cut_bus", "unplug", "kill_driver"), _BY_ITSELF),
    **dict.fromkeys(("reboot", "hang"), _SILENT),
    "emcy": _TOLD,
}
# A rotation that does not follow is noticed when it is so far off [rad]; then come the patience of
# the drive, a cycle and a ramp [s].
_FOLLOWING, _NOTICED = 0.1, 0.17
_COUNT = 5.1e-8  # [m]


def many_steps(_: Workbench) -> Iterator[Finding]:
    """Add up random steps to the count, lose no message, take no more memory."""
    seen = in_own_process(random_steps, STEPS)
    off, failures = seen["off_counts"], seen["failures"]
    yield Finding(
        "steps_position",
        f"{STEPS:,} random steps: the motors' place against the sum of commands",
        "within one count",
        f"{off[0]:+.2f} and {off[1]:+.2f} counts, after {seen['retractions']} retractions",
        max(map(abs, off)) <= 1.0,
    )
    yield Finding(
        "steps_messages",
        "results, joint_states and positions of each cycle",
        "every one but those under way at both ends, all steps succeeded",
        f"{seen['results']} results, {len(failures)} other {failures[:1]}, {seen['silent_cycles']} "
        "cycles without joints or positions",
        seen["results"] == STEPS and not failures and seen["silent_cycles"] <= 2,
    )
    what, wanted = "memory, from a tenth of the steps on", f"at most {MEMORY_SLACK:g} MB more"
    growth = seen["growth_MB"]
    yield Finding("steps_memory", what, wanted, f"{growth:+.2f} MB", growth <= MEMORY_SLACK)


def faults(_: Workbench) -> Iterator[Finding]:
    """End every motion within its bound, whatever breaks, and go on only when told."""
    for kind in FAULTS:
        outcomes = fault_trials(kind, MOMENTS)
        over = [one for one in outcomes if one["distance"] > _allowed(kind, one)]
        longest = max(outcomes, key=lambda one: float(one["distance"]))
        yield Finding(
            f"{kind}_bound",
            f"{kind} at {MOMENTS} moments: way of the needle afterwards",
            "within the bound at the step's speed",
            f"{len(over)} beyond; longest {longest['distance'] * 1e3:.3f} mm at "
            f"{longest['speed'] * 1e3:.1f} mm/s, bound {_allowed(kind, longest) * 1e3:.3f} mm",
            not over,
        )
        reasons = [one["why"] for one in outcomes if one["why"]]
        named = f"{len(reasons)} of {MOMENTS}, such as {reasons[:1]}"
        wanted = "FAULT with the reason on device/status, or of both drives"
        yield Finding(
            f"{kind}_named", f"{kind}: what is said", wanted, named, len(reasons) == MOMENTS
        )
        moved = max(one["moved"] for one in outcomes)
        troubles = [one["trouble"] for one in outcomes if one["trouble"]]
        yield Finding(
            f"{kind}_recovery",
            f"{kind}: motion without a command; a step after reset and enable",
            "at most one count (50 nm), the step succeeds",
            f"{moved * 1e9:.0f} nm; {len(troubles)} do not {troubles[:1]}",
            moved <= _COUNT and not troubles,
        )


def killed_nodes(_: Workbench) -> Iterator[Finding]:
    """End every motion within its bound when a node of the graph is killed; go on when told."""
    rng = random.Random(4)
    for node in PARTS:
        ends = [in_own_process(_kill, n, node, rng.uniform(0.0, 2.0)) for n in range(MOMENTS)]
        said = [f"{one.invariant}: {one.text}" for result in ends for one in result.violations]
        yield Finding(
            f"killed_{node}",
            f"kill -9 of {node} at {MOMENTS} moments of an insertion in real time",
            "no motion beyond the command and the hold, none by itself; the way goes on",
            f"{len(said)} violations {said[:2]}",
            not said,
        )


def _kill(seed: int, node: str, at: float) -> RunResult:
    with tempfile.TemporaryDirectory(prefix="needle_trial_") as name:
        return run_processes(seed, Path(name), [Fault(node, Kind.OFF, at, 3.0, 0.0)])


CHECKS: tuple[Check, ...] = (many_steps, faults, killed_nodes)


def _allowed(kind: str, one: dict[str, Any]) -> float:
    """Return how far the needle may go after a fault [m]."""
    if kind != "stall":
        seconds, way = BOUNDS[kind]
        return float(way + one["speed"] * seconds)
    # The insertion goes on until the rotation is far enough off.
    until = 0.0 if one["axis"] == "insertion" else _FOLLOWING / one["turn_rate"] + _NOTICED
    return float(5e-5 + one["speed"] * until)
