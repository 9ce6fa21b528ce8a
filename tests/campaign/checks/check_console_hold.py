"""Step I: whatever is lost between a finger and the console, the needle stops and stays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from campaign.checking import Check, Finding, Workbench, trial_outcomes

TRIALS = "campaign.trials.console.console_trials"
MOMENTS = 50
LOSSES = {
    "closed": "page closed",
    "hidden": "tab hidden",
    "unfocused": "focus lost",
    "stopped": "browser SIGSTOPped for 0.2 to 2 s",
    "killed": "browser killed",
    "stalled": "socket stalled for 0.1 to 5 s, then a burst",
    "asleep": "server SIGSTOPped for 0.2 to 2 s",
}
LONGEST_MS = {**dict.fromkeys(LOSSES, 300.0), "asleep": 150.0}
"""Last motion after a loss, the stopping way apart; of the server's the driver knows sooner."""

# What stops at once is seen to have moved in the joints of the tick before, and heard after it.
_TICK_MS = 20.0


def console_hold(_: Workbench, moments: int = MOMENTS) -> Iterator[Finding]:
    """Lose page, focus, browser, connection and server while a page's button is held at 5 mm/s."""
    for loss in LOSSES:
        yield judge(loss, trial_outcomes(TRIALS, moments, loss))


def judge(loss: str, outcomes: Sequence[dict[str, Any]]) -> Finding:
    """Return what the trials of one loss show."""
    times = sorted(float(outcome["last_motion_ms"]) for outcome in outcomes)
    longest = LONGEST_MS[loss]
    way = max(float(outcome["way_mm"]) for outcome in outcomes)
    resumed = sum(bool(outcome["resumed"]) for outcome in outcomes)
    return Finding(
        f"console_{loss}",
        f"{LOSSES[loss]}, the needle held at 5 mm/s, {len(outcomes)} random moments: last motion",
        f"at most {longest:g} ms after it and one tick of {_TICK_MS:g} ms, 0 resumed",
        f"at most {times[-1]:.0f} ms, half of them {times[len(times) // 2]:.0f} ms; "
        f"{way:.2f} mm; {resumed} resumed",
        times[-1] <= longest + _TICK_MS and resumed == 0,
    )


CHECKS: tuple[Check, ...] = (console_hold,)
