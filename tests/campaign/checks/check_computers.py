"""Step K: a rig on two computers, and the cable between them."""

from __future__ import annotations

from collections.abc import Iterator

from campaign.checking import Check, Finding, Workbench, trial_outcomes

TRIALS = "campaign.trials.computers.cable_trials"
CUTS, WRONG_CUTS = 50, 5
WRONG = 0.2  # [s]
# A hold lives for 100 ms; then come a cycle and a quick stop. Beside it, how late the last hold
# before the cut came, and how often the drives say where they are [ms].
LIFETIME, STOP, DELAY, SAMPLING = 100.0, 30.0, 5.0, 20.0
BOUND = LIFETIME + STOP + DELAY + SAMPLING


def two_computers(_: Workbench, cuts: int = CUTS) -> Iterator[Finding]:
    """End every motion soon after the cable is cut, go on only when a person presses anew."""
    outcomes = trial_outcomes(TRIALS, cuts)
    # A cut that is shorter than the hold's life need not end it.
    lost = [outcome for outcome in outcomes if outcome["lost"]]
    kept = [outcome for outcome in outcomes if not outcome["lost"]]
    too_long = [o for o in kept if float(o["length_s"]) * 1e3 > LIFETIME + STOP]
    latest = max((float(outcome["last_motion_ms"]) for outcome in lost), default=0.0)
    way = max((float(outcome["distance_mm"]) for outcome in lost), default=0.0)
    moving = sum(bool(outcome["moving"]) for outcome in outcomes)
    yield Finding(
        "cable_cut",
        f"cable between two computers cut for 0.1 to 5 s at {len(outcomes)} random moments at "
        "5 mm/s, 5 ms late and 1 % lost at all times: last motion, by the drives",
        f"at most {BOUND:g} ms after the cut",
        f"at most {latest:.0f} ms, {way:.2f} mm (moving at {moving} cuts; {len(kept)} cuts too "
        "short to end the hold)",
        latest <= BOUND and not too_long and len(outcomes) == cuts,
    )
    resumed = sum(float(outcome["resumed_mm"]) > 0.0 for outcome in lost)
    yield Finding(
        "cable_mended",
        "2 s after the cable is mended, the hold still pressed: motions by themselves",
        "none",
        f"{resumed}",
        resumed == 0,
    )
    again = max((float(outcome["again_s"]) for outcome in outcomes), default=0.0)
    yield Finding(
        "pressed_again",
        "then let go and pressed again: the needle goes on",
        "each time",
        f"{len(outcomes)} of {cuts}, at the latest {again:.1f} s after letting go",
        len(outcomes) == cuts,
    )


def clocks_differ(_: Workbench, cuts: int = WRONG_CUTS) -> Iterator[Finding]:
    """End every motion as soon where the cameras stamp by another clock."""
    for ahead in (-WRONG, WRONG):
        outcomes = trial_outcomes(TRIALS, cuts, "--clock-ahead", ahead)
        latest = max((float(outcome["last_motion_ms"]) for outcome in outcomes), default=0.0)
        resumed = sum(float(outcome["resumed_mm"]) > 0.0 for outcome in outcomes)
        yield Finding(
            f"clock_{'ahead' if ahead > 0.0 else 'behind'}",
            f"the same, {cuts} cuts, the cameras' clock {ahead:+g} s off",
            f"last motion at most {BOUND:g} ms after the cut; none by itself",
            f"at most {latest:.0f} ms after {len(outcomes)} cuts; {resumed}",
            latest <= BOUND and resumed == 0 and len(outcomes) == cuts,
        )


CHECKS: tuple[Check, ...] = (two_computers, clocks_differ)
