"""Step I: continuous insertion at the operator's speed, or by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from campaign.checking import Check, Finding, Workbench
from campaign.checks.control_studies import Study, run
from campaign.trials.steered_needle import (
    Hand,
    changing,
    constant_speed,
    pushing,
    rms_at_end,
    steer,
)
from needle_device_driver.conformance.rig import FASTEST

SEED, NEEDLES = 1400, 12
HANDS: dict[str, tuple[float, Callable[[np.random.Generator], Hand]]] = {
    "0.5 mm/s": (0.06, lambda _: constant_speed(0.0005)),
    "2 mm/s": (0.06, lambda _: constant_speed(0.002)),
    "5 mm/s": (0.06, lambda _: constant_speed(FASTEST)),
    "0 to 5 mm/s, stops, releases": (0.06, changing),
    "pushed, jerks to 20 mm/s": (0.25, pushing),
}


def hands(_: Workbench) -> Iterator[Finding]:
    """Steer while the operator changes speed, stops, releases, or pushes the needle by hand."""
    for name, (bound, new_hand) in HANDS.items():
        errors, done = [], 0
        for seed in range(SEED, SEED + NEEDLES):
            hand = new_hand(np.random.default_rng(seed))
            state, path = steer(hand, seed, pushed=name.startswith("pushed"))
            errors.append(rms_at_end(path) * 1e3)
            done += state == "DONE"
        rms = math.sqrt(float(np.mean(np.square(errors))))
        yield Finding(
            f"continuous_{name.split()[0].strip(',').replace('.', '_')}_{len(name)}",
            f"{name}: r1 over the last 20 mm, {NEEDLES} needles",
            f"<= {bound:g} mm RMS, all at the depth",
            f"{rms:.3f} mm, worst {max(errors):.3f}; {done} of {NEEDLES}",
            rms <= bound and done == NEEDLES,
        )


def frame_rates(bench: Workbench) -> Iterator[Finding]:
    """Compare preset best at 5 mm/s with stepwise insertion, at several frame rates."""
    # 5 mm/s times 10, 33 and 100 ms; tips between two used ones have no effect.
    figures = {
        delay: run(Study(f"delay_{delay}", "best", ("--turn-delay-mm", delay)), bench.folder)
        for delay in ("0", "0.05", "0.17", "0.5")
    }
    stepwise = figures.pop("0")["rms_last_20_mm"]
    for delay, figure in figures.items():
        rms, there = figure["rms_last_20_mm"], figure["converged_at_end"]
        yield Finding(
            f"continuous_turn_delay_{delay}",
            f"10,000 needles, turned {delay} mm after each used tip",
            f"RMS within 10 % of stepwise ({stepwise:.4f} mm), >= 99.95 % within 1 mm",
            f"{rms:.4f} mm, {there:.2%}",
            rms <= 1.1 * stepwise and there >= 0.9995,
        )


CHECKS: tuple[Check, ...] = (hands, frame_rates)
