"""Step I: whatever is lost between a finger and the console, the needle stops and stays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from needle_verification.checking import Check, Finding, Workbench, trial_outcomes

TRIALS = "needle_verification.ros.console.console_trials"
MOMENTS, HOSTILE = 50, 10
LOSSES = {
    "closed": "page closed",
    "hidden": "tab hidden",
    "unfocused": "focus lost",
    "stopped": "browser SIGSTOPped for 0.2 to 2 s",
    "killed": "browser killed",
    "stalled": "socket stalled for 0.1 to 5 s, then a burst",
    "asleep": "server SIGSTOPped for 0.2 to 2 s",
}
_WORDS = {**LOSSES, "hostile": "let go on the right page, among hostile ones"}
HOSTILE_KINDS = (
    "foreign Host",
    "foreign Origin",
    "wrong token",
    "message not understood",
    "message too long",
    "too many messages",
    "too many pages",
    "unknown nonce",
)
LONGEST_MS = {**dict.fromkeys(_WORDS, 300.0), "asleep": 150.0}
"""Last motion after a loss, the stopping way apart; of the server's the driver knows sooner."""

# What stops at once is seen to have moved in the joints of the tick before, and heard after it.
_TICK_MS = 20.0


def console_hold(_: Workbench, moments: int = MOMENTS) -> Iterator[Finding]:
    """Lose page, focus, browser, connection and server while a page's button is held at 5 mm/s."""
    for loss in LOSSES:
        yield judge(loss, trial_outcomes(TRIALS, moments, loss))


def console_hostile(_: Workbench, count: int = HOSTILE) -> Iterator[Finding]:
    """Move nothing by hostile pages, and end the hold of the right one among them."""
    yield from judge_hostile(trial_outcomes(TRIALS, count, "hostile"))


def judge(loss: str, outcomes: Sequence[dict[str, Any]]) -> Finding:
    """Return what the trials of one loss show."""
    times = sorted(float(outcome["last_motion_ms"]) for outcome in outcomes)
    longest = LONGEST_MS[loss]
    way = max(float(outcome["way_mm"]) for outcome in outcomes)
    resumed = sum(bool(outcome["resumed"]) for outcome in outcomes)
    return Finding(
        f"console_{loss}",
        f"{_WORDS[loss]}, the needle held at 5 mm/s, {len(outcomes)} random moments: last motion",
        f"at most {longest:g} ms after it and one tick of {_TICK_MS:g} ms, 0 resumed",
        f"at most {times[-1]:.0f} ms, half of them {times[len(times) // 2]:.0f} ms; "
        f"{way:.2f} mm; {resumed} resumed",
        times[-1] <= longest + _TICK_MS and resumed == 0,
    )


def judge_hostile(outcomes: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Yield what the trials among hostile pages show."""
    moved = sum(bool(outcome["moved_by_others"]) for outcome in outcomes)
    yield Finding(
        "console_hostile_moves",
        "wrong tokens, foreign Host and Origin, garbage, NaN, huge frames, 10,000 messages, "
        f"50 pages at once, replays, {len(outcomes)} times: needle moved by it",
        "0 times",
        f"{moved} times",
        moved == 0,
    )
    said = list(outcomes[-1]["refused"])
    missing = [kind for kind in HOSTILE_KINDS if said.count(kind) != 1]
    yield Finding(
        "console_hostile_said",
        "what was refused of it",
        "each kind said once",
        f"once each of {len(set(said))} kinds" if not missing else f"not so: {', '.join(missing)}",
        not missing,
    )
    yield judge("hostile", outcomes)


CHECKS: tuple[Check, ...] = (console_hold, console_hostile)
