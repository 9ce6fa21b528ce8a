"""Step D: the device driver on emulated drives: exact, repeatable, never an unbounded motion."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

from campaign.checking import (
    Check,
    Finding,
    SimulateRun,
    Workbench,
    payloads,
    trial_outcomes,
)
from needle_core.commands.cli import EXIT_DONE

STEPS = 10_000
MOMENTS = 50
SAME_TOPICS = (
    "/joint_states",
    "/sim/drive_positions",
    "/device/joint_trajectory",
    "/device/result",
    "/sim/tip_pose",
)
SHORT = ("--level", "drive", "--depth-mm", "40")
# What the memory of both processes may grow by in 9,000 steps [MB]: less than a byte a cycle.
MEMORY_SLACK = 2.0
# Where a motor was when a node was killed is known from what was heard last, 50 times a second [s].
SAMPLING = 0.04


@dataclasses.dataclass(frozen=True)
class Bound:
    """Bound of a motion that goes on at its speed after a fault, docs/safety.md.

    Attributes
    ----------
    time : float
        [s].
    way : float
        What comes on top, ramps included [mm].
    """

    time: float
    way: float = 0.05


# A drive ends at the last set-point by itself: at most the one sent and the one under way.
_BY_ITSELF = Bound(0.04, 0.005)
# The other drive gets no set-point more once one has left a SYNC unanswered.
_SILENT = Bound(0.08)
_TOLD = Bound(0.02 + 0.05)
BOUNDS = {
    "cut_bus": _BY_ITSELF,
    "unplug": _BY_ITSELF,
    "kill_driver": Bound(0.04 + SAMPLING, 0.005),
    "reboot": _SILENT,
    "hang": _SILENT,
    "emcy": _TOLD,
}
# A rotation that does not follow is noticed when it is so far off [rad]; then come the patience of
# the drive, a cycle and a ramp [s].
_FOLLOWING = 0.1
_NOTICED = 0.17


def many_steps(_: Workbench, count: int = STEPS) -> Iterator[Finding]:
    """Add up random steps to the count, lose no message, take no more memory."""
    (seen,) = _trials("steps", count)
    off = [seen["final_off_insertion_counts"], seen["final_off_rotation_counts"]]
    yield Finding(
        "steps_position",
        f"{count:,} random steps: the motors' place against the sum of commands",
        "within one count",
        f"{off[0]:+.2f} counts in insertion, {off[1]:+.2f} in rotation, after "
        f"{seen['retractions']} retractions",
        max(map(abs, off)) <= 1.0,
    )
    lost = seen["cycles"] - min(seen["joint_states"], seen["drive_positions"])
    yield Finding(
        "steps_messages",
        f"{count:,} random steps: results, joint_states and positions of each cycle",
        "every one but those under way at both ends, all steps succeeded",
        f"{seen['results']} results, {seen['not_succeeded']} not succeeded"
        f"{''.join(f' ({text})' for text in seen['not_succeeded_for'])}; {lost} of "
        f"{seen['cycles']} cycles without joints or positions",
        seen["results"] == count and seen["not_succeeded"] == 0 and lost <= 2,
    )
    yield Finding(
        "steps_memory",
        "memory of driver and drives, from a tenth of the steps to the end",
        f"at most {MEMORY_SLACK:g} MB more",
        f"{seen['memory_growth_MB']:+.2f} MB",
        seen["memory_growth_MB"] <= MEMORY_SLACK,
    )


def drive_level(bench: Workbench) -> Iterator[Finding]:
    """Converge with the real driver on emulated drives."""
    run = bench.run("drive", "--level", "drive")
    summary = run.summary
    r1 = summary.get("r1_final_mm")
    yield Finding(
        "drive_converged",
        "scripts/simulate --level drive: exit code, |r1| at 120 mm, processes left",
        "0, at most 1 mm, none",
        f"{run.code}, {math.nan if r1 is None else r1:.2f} mm, {len(run.left_over)}; "
        f"{summary.get('steps_per_s', math.nan):.1f} steps/s",
        run.code == EXIT_DONE and r1 is not None and abs(r1) <= 1.0 and not run.left_over,
    )


def same_joints(bench: Workbench) -> Iterator[Finding]:
    """Repeat a run's joint positions with its seed."""
    one, again = (bench.run(f"drive_{name}", *SHORT, "--seed", "5") for name in ("one", "again"))
    ours, theirs = _told(one), _told(again)
    differ = [topic for topic in SAME_TOPICS if ours[topic] != theirs[topic] or not ours[topic]]
    yield Finding(
        "drive_same_seed",
        f"level drive, one seed twice: {', '.join(SAME_TOPICS)}",
        "the same, bit for bit",
        f"different: {', '.join(differ)}" if differ else "the same",
        not differ,
    )


def _told(run: SimulateRun) -> dict[str, list[bytes]]:
    """Return what was said, each thing once: joints are repeated while time stands still."""
    return {
        topic: [data for data, _ in itertools.groupby(messages)]
        for topic, messages in payloads(run.bag, SAME_TOPICS).items()
    }


def faults(_: Workbench, moments: int = MOMENTS) -> Iterator[Finding]:
    """End every motion within its bound, whatever breaks, and go on only when told."""
    for kind in (*BOUNDS, "stall"):
        yield from judge(kind, _trials("faults", moments, kind))


def killed_nodes(_: Workbench, moments: int = MOMENTS) -> Iterator[Finding]:
    """End every motion within its bound when a node of the graph is killed."""
    # Nominal 2 mm/s: the step under way ends, and at most one more was ordered already.
    ways = {
        "plane_controller": 2.0,
        "stereo_tracker": 2.0,
        "simulated_operator": 2.0 * (0.25 + 0.07),
    }
    for kind, way in ways.items():
        outcomes = _trials("kills", moments, kind)
        longest = max(float(outcome["distance_mm"]) for outcome in outcomes)
        allowed = way + 2.0 * SAMPLING
        moved = max(float(outcome["moved_by_itself_mm"]) for outcome in outcomes)
        yield Finding(
            f"killed_{kind}",
            f"kill -9 of {kind} at {len(outcomes)} moments: way afterwards, then by itself",
            f"at most {allowed:.2f} mm, then nothing; steering goes on when put right",
            f"at most {longest:.2f} mm, then {moved:.4f} mm",
            longest <= allowed and moved == 0.0 and len(outcomes) == moments,
        )


CHECKS: tuple[Check, ...] = (
    drive_level,
    same_joints,
    many_steps,
    faults,
    killed_nodes,
)


def judge(kind: str, outcomes: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Yield what the trials of one fault show."""
    over = [outcome for outcome in outcomes if outcome["distance_mm"] > _allowed(kind, outcome)]
    longest = max(outcomes, key=lambda outcome: float(outcome["distance_mm"]))
    yield Finding(
        f"{kind}_bound",
        f"{kind} at {len(outcomes)} moments: way of the needle afterwards",
        "within the bound at the step's speed",
        f"{len(over)} beyond; longest {longest['distance_mm']:.3f} mm at "
        f"{longest['speed_mm_s']:.1f} mm/s, bound {_allowed(kind, longest):.3f} mm",
        not over,
    )
    yield from judge_recovery(kind, outcomes)


def judge_recovery(kind: str, outcomes: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Yield what the trials of one fault show, apart from distances."""
    if kind == "kill_driver":
        # Nobody is left to say why, but the drives.
        named = sum(outcome["drives_faulted"] == 2 for outcome in outcomes)
        wanted = "both drives report the missing heartbeat"
    else:
        named = sum(outcome["state"] == "FAULT" and outcome["logged"] for outcome in outcomes)
        wanted = "FAULT with the reason on device/status and in the log"
    reasons = sorted({str(outcome["reason"]) for outcome in outcomes if outcome["reason"]})
    yield Finding(
        f"{kind}_named",
        f"{kind}: what is said",
        wanted,
        f"{named} of {len(outcomes)}" + (f", such as '{reasons[0]}'" if reasons else ""),
        named == len(outcomes),
    )
    moved = max(float(outcome["moved_by_itself_mm"]) for outcome in outcomes)
    troubles = [str(outcome["trouble_after"]) for outcome in outcomes if outcome["trouble_after"]]
    yield Finding(
        f"{kind}_recovery",
        f"{kind}: motion without a command; a step after reset and enable",
        "at most one count (50 nm), the step succeeds",
        f"{moved * 1e6:.0f} nm; {len(outcomes) - len(troubles)} of {len(outcomes)} succeed"
        + (f" ({troubles[0]})" if troubles else ""),
        moved <= 5.1e-5 and not troubles,
    )


def _allowed(kind: str, outcome: dict[str, Any]) -> float:
    speed = float(outcome["speed_mm_s"])
    if kind == "stall":
        if outcome["words"].endswith("insertion"):
            return 0.05
        # The insertion goes on until the rotation is far enough off.
        until = _FOLLOWING / float(outcome["turn_rate_rad_s"]) + _NOTICED
        return 0.05 + speed * until
    bound = BOUNDS[kind]
    return bound.way + speed * bound.time


def _trials(*words: object) -> list[dict[str, Any]]:
    return trial_outcomes("campaign.trials.drives.drive_trials", *words)
