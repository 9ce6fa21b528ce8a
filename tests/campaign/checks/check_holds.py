"""Steps I and K: a hold ends with its operator, and nothing resumes by itself."""

from __future__ import annotations

from collections.abc import Iterator

from campaign.checking import Check, Finding, Workbench, in_own_process
from campaign.trials.holds.hold_trials import CABLE, FROZEN, hold_trials

MOMENTS = 50
# Longest time from a loss to the last motion, and period of the joint samples [ms].
BOUND, SAMPLING = 150.0, 20.0


def hold_sources(_: Workbench) -> Iterator[Finding]:
    """Suspend the operator node: motion ends in time and does not resume."""
    what = "operator stopped by SIGSTOP, and going on with the pedal still pressed"
    yield _finding(FROZEN, what)


def two_computers(_: Workbench) -> Iterator[Finding]:
    """Cut the cable: motion ends in time, and continues only after a new press."""
    what = "cable between two computers cut for 0.3 to 5 s, 5 ms late and 1 % lost at all times"
    yield _finding(CABLE, what)


def _finding(kind: str, what: str) -> Finding:
    outcomes = in_own_process(hold_trials, kind, MOMENTS)
    latest, distance, again = (
        max(float(one[key]) for one in outcomes)
        for key in ("last_motion_ms", "distance_mm", "again_s")
    )
    moving = sum(bool(one["moving"]) for one in outcomes)
    resumed = [f"{one['resumed_mm']:.2f} mm" for one in outcomes if one["resumed_mm"] > 0.0]
    return Finding(
        kind,
        f"{what}, at {MOMENTS} random moments at 5 mm/s: last motion; then motion "
        "without a press; a new press continues",
        f"at most {BOUND:g} ms (and {SAMPLING:g} ms between samples) after the loss; none",
        f"at most {latest:.0f} ms, {distance:.2f} mm (moving at {moving} losses); {len(resumed)} "
        f"{resumed[:3]}; within {again:.1f} s",
        latest <= BOUND + SAMPLING and not resumed,
    )


HOLD_CHECKS: tuple[Check, ...] = (hold_sources,)
COMPUTER_CHECKS: tuple[Check, ...] = (two_computers,)
