"""Step I: whatever a person holds, its hold ends with it, and nothing moves on by itself."""

from __future__ import annotations

from collections.abc import Iterator

from needle_verification.checking import Check, Finding, Workbench, trial_outcomes

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
        outcomes = trial_outcomes("needle_verification.ros.holds.hold_trials", moments, kind)
        latest = max(float(outcome["last_motion_ms"]) for outcome in outcomes)
        way = max(float(outcome["distance_mm"]) for outcome in outcomes)
        moving = sum(bool(outcome["moving"]) for outcome in outcomes)
        resumed = sum(float(outcome["resumed_mm"]) > 0.0 for outcome in outcomes)
        yield Finding(
            kind,
            f"{what}, at {len(outcomes)} random moments at 5 mm/s: last motion, then by itself",
            f"at most {BOUND:g} ms (and {SAMPLING:g} ms between samples) after the loss; none",
            f"at most {latest:.0f} ms, {way:.2f} mm (moving at {moving} losses); resumed by "
            f"itself: {resumed}",
            latest <= BOUND + SAMPLING and resumed == 0 and len(outcomes) == moments,
        )


CHECKS: tuple[Check, ...] = (hold_sources,)
