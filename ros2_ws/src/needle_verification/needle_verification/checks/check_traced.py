"""Step C on metal under lamps: a tracker for real images, as far as path tracing goes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from ament_index_python.packages import get_package_share_directory

from needle_verification.checking import Check, Finding, Workbench
from needle_verification.studies.traced_study import Told, TracedAnswer, traced_looks
from needle_verification.studies.tracker_study import WRONG

SCENES, EMPTY = range(9001, 9101), range(9201, 9243)
"""Seeds that nothing was trained or tuned on."""
_CHI_SQUARED_95 = 7.815  # of three degrees of freedom


def path_traced(_: Workbench) -> Iterator[Finding]:
    """Find metal needles under lamps, over floors of all kinds; say how well they are known."""
    calibration = Path(get_package_share_directory("needle_tracker"), "config", "calibration.yaml")
    looks = list(traced_looks(calibration, "random", SCENES))
    for told, least in ((Told.EMPTY_PHANTOM, 0.97), (Told.INSERTION, 0.97), (Told.NOTHING, 0.92)):
        yield from _found([look for look in looks if look.told is told], told, least)
    yield from _errors(looks)
    empty = list(traced_looks(calibration, "absent", EMPTY))
    false = sum(look.tip is not None for look in empty)
    yield Finding(
        "path_traced_absent", f"no needle, {len(empty)} looks: tips", "0", str(false), false == 0
    )


CHECKS: tuple[Check, ...] = (path_traced,)


def _found(looks: Sequence[TracedAnswer], told: Told, least: float) -> Iterator[Finding]:
    key = told.name.lower()
    seen = [look.tip is not None for look in looks]
    yield Finding(
        f"path_traced_found_{key}",
        f"path-traced, {told.value} insertion, {len(looks)} pairs: a tip",
        f">= {least:.0%}",
        f"{np.mean(seen):.1%}",
        float(np.mean(seen)) >= least,
    )
    kinds: defaultdict[str, list[bool]] = defaultdict(list)
    for look, found in zip(looks, seen, strict=True):
        for kind in (look.scene.metal, look.scene.lamps, look.scene.floor):
            kinds[kind].append(found)
    worst = min(kinds, key=lambda kind: float(np.mean(kinds[kind])))
    share = float(np.mean(kinds[worst]))
    yield Finding(
        f"path_traced_each_{key}",
        f"path-traced, {told.value} insertion: a tip on each metal, light and floor",
        ">= 85%",
        f"least {share:.1%} ({worst}, {len(kinds[worst])} pairs)",
        share >= 0.85,
    )


def _errors(looks: Sequence[TracedAnswer]) -> Iterator[Finding]:
    tips = [look for look in looks if look.tip is not None]
    errors = 1e3 * np.array([look.error for look in tips if look.told is not Told.NOTHING])
    largest = 1e3 * max(look.error for look in tips)
    p95 = float(np.percentile(errors, 95))
    yield Finding(
        "path_traced_errors",
        f"path-traced: error of {len(errors)} tips with insertion; largest of all {len(tips)}",
        f"95 % <= 0.3 mm; <= {1e3 * WRONG:g} mm",
        f"95 % {p95:.2f} (median {np.median(errors):.2f}); {largest:.2f} mm",
        p95 <= 0.3 and largest <= 1e3 * WRONG,
    )
    inside = float(np.mean([look.normalised <= _CHI_SQUARED_95 for look in tips]))
    yield Finding(
        "path_traced_consistency",
        f"path-traced: {len(tips)} tips within the 95 % ellipsoid that they claim",
        "85 to 99.5 %",
        f"{inside:.1%}",
        0.85 <= inside <= 0.995,
    )
