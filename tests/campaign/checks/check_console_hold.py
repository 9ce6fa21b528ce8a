"""Step I: whatever is lost between a finger and the console, the hold ends and stays ended."""

from __future__ import annotations

from collections.abc import Iterator

from campaign.checking import Check, Finding, Workbench

MOMENTS = 50
# docs/safety.md, hold's end; and the server tells what counts every 20 ms [ms]. What is said to be
# held later than that began anew.
LONGEST, TICK = 250.0, 20.0


def console_hold(bench: Workbench) -> Iterator[Finding]:
    """Lose page, sight, focus, browser and connection while a page's button is held."""
    # Only what tries a browser needs websockets.
    from campaign.trials.console.held_page import LOSSES, page_trials  # noqa: PLC0415

    for loss in LOSSES:
        folder = bench.folder / f"console_{loss}"
        folder.mkdir()
        outcomes = page_trials(folder, loss, MOMENTS)
        times = sorted(float(one["last_ms"]) for one in outcomes)
        held = sum(bool(one["held"]) for one in outcomes)
        yield Finding(
            f"console_{loss}",
            f"{loss} at {MOMENTS} random moments of a hold: told last to be held",
            f"at most {LONGEST:g} ms after it and one tick of {TICK:g} ms",
            f"at most {times[-1]:.0f} ms, half of them {times[len(times) // 2]:.0f} ms; held at "
            f"{held} losses",
            times[-1] <= LONGEST + TICK,
        )


CHECKS: tuple[Check, ...] = (console_hold,)
