"""Step I: whatever a person holds, its hold ends with it, and nothing moves on by itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from campaign.checking import Check, Finding, Workbench, trial_outcomes

MOMENTS = 50
# From a loss to the last motion, and between two samples of the joints that can show it [ms].
BOUND, SAMPLING = 150.0, 20.0
WHAT = {
    "pedal_unplugged": "pedal unplugged, and plugged in again still pressed",
    "joy_silent": "joy node silent, and talking again with its button still pressed",
    "operator_frozen": "operator stopped by SIGSTOP, and going on with the pedal still pressed",
}


def hold_sources(_: Workbench, moments: int = MOMENTS) -> Iterator[Finding]:
    """End every motion soon after its pedal or joystick is lost, and never resume it."""
    for kind, what in WHAT.items():
        outcomes = trial_outcomes("campaign.trials.holds.hold_trials", moments, kind)
        latest = max(float(outcome["last_motion_ms"]) for outcome in outcomes)
        way = max(float(outcome["distance_mm"]) for outcome in outcomes)
        moving = sum(bool(outcome["moving"]) for outcome in outcomes)
        resumed = [outcome for outcome in outcomes if float(outcome["resumed_mm"]) > 0.0]
        # A device that stood still itself ends the tick in which it was stopped when it goes on.
        how = "".join(f"; {_told(outcome)}" for outcome in resumed)
        yield Finding(
            kind,
            f"{what}, at {len(outcomes)} random moments at 5 mm/s: last motion, then by itself",
            f"at most {BOUND:g} ms (and {SAMPLING:g} ms between samples) after the loss; none",
            f"at most {latest:.0f} ms, {way:.2f} mm (moving at {moving} losses); resumed by "
            f"itself: {len(resumed)}{how}",
            latest <= BOUND + SAMPLING and not resumed and len(outcomes) == moments,
        )


def _told(outcome: Mapping[str, Any]) -> str:
    way, silent = float(outcome["resumed_mm"]), float(outcome["silent_ms"])
    return f"{way:.2f} mm, the rig silent for {silent:.0f} ms"


CHECKS: tuple[Check, ...] = (hold_sources,)
