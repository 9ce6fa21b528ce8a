"""Step C on path-traced images: metal needles under lamps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from campaign.checking import Check, Finding, Workbench, at_least, at_most
from campaign.tracking.traced_set import RIGS, drawn
from campaign.tracking.traced_study import VARIATIONS, KnownInput, TrackedPair, tracked_pairs
from campaign.tracking.tracker_study import WRONG
from needle_bringup.workplace import checkout

_LEAST = 0.97
_LEAST_OF_A_KIND = 0.85
_LEAST_VARIED = 0.9
_LARGEST_P95 = {"bench": 0.3, "top_and_side": 0.25, "webcams": 0.3}  # [mm]
_CHI_SQUARED_95 = 7.815  # of three degrees of freedom


def path_traced(_: Workbench) -> Iterator[Finding]:
    """Find metal needles under lamps over all floors, with consistent covariances.

    Missing sequences are traced first.
    """
    looks = [
        look
        for sequence in drawn(checkout() / ".traced")
        for known in KnownInput
        for look in tracked_pairs(sequence, known)
    ]
    needles = [look for look in looks if look.truth is not None]
    for known in KnownInput:
        found = _found([look for look in needles if look.known is known])
        key = f"path_traced_found_{known.name.lower()}"
        what = f"path-traced, {known.value} insertion, {_pairs(needles)} pairs: a tip"
        yield at_least(key, what, _LEAST, found, form=".1%")
    yield from _kinds(needles)
    for rig in RIGS:
        yield from _errors(rig, [look for look in needles if look.scene.rig == rig])
    tips = [look for look in needles if look.tip is not None]
    inside = float(np.mean([look.normalized <= _CHI_SQUARED_95 for look in tips]))
    what = f"path-traced: {len(tips)} tips within the 95 % ellipsoid that they claim"
    passed = 0.85 <= inside <= 0.995
    yield Finding("path_traced_consistency", what, "85 to 99.5 %", f"{inside:.1%}", passed)
    empty = [look for look in looks if look.truth is None]
    false = sum(look.tip is not None for look in empty)
    yield at_most("path_traced_absent", f"no needle, {len(empty)} looks: tips", 0, false)


def path_traced_variations(_: Workbench) -> Iterator[Finding]:
    """Find the same needles with degraded images or wrong parameters."""
    sequences = [
        sequence for sequence in drawn(checkout() / ".traced") if sequence.scene.look.needle
    ]
    for variation in VARIATIONS:
        looks = [
            look
            for sequence in sequences
            for look in tracked_pairs(sequence, KnownInput.INSERTION, variation)
        ]
        tips = [look for look in looks if look.tip is not None]
        found, median = _found(looks), 1e3 * float(np.median([look.error for look in tips]))
        inside = float(np.mean([look.normalized <= _CHI_SQUARED_95 for look in tips]))
        wrong = sum(look.error > WRONG for look in tips)
        yield Finding(
            "path_traced_" + variation.name.replace(" ", "_"),
            f"path-traced, {variation.name}, {len(looks)} pairs with the insertion",
            f">= {_LEAST_VARIED:.0%} found, 0 wrong",
            f"{found:.1%} found, {wrong} wrong, median {median:.2f} mm, {inside:.1%} within 95 %",
            found >= _LEAST_VARIED and wrong == 0,
        )


CHECKS: tuple[Check, ...] = (path_traced, path_traced_variations)


def _found(looks: Sequence[TrackedPair]) -> float:
    return float(np.mean([look.tip is not None for look in looks]))


def _pairs(looks: Sequence[TrackedPair]) -> int:
    return len(looks) // len(KnownInput)


def _kinds(needles: Sequence[TrackedPair]) -> Iterator[Finding]:
    """Yield the share found for each rig, metal, light and floor."""
    kinds: dict[str, list[TrackedPair]] = {}
    for look in needles:
        appearance = look.scene.look
        for kind in (look.scene.rig, appearance.metal, appearance.lamps, appearance.floor):
            kinds.setdefault(kind, []).append(look)
    for kind, looks in sorted(kinds.items()):
        shares = [_found([look for look in looks if look.known is known]) for known in KnownInput]
        yield Finding(
            f"path_traced_{kind}",
            f"path-traced, {kind}, {_pairs(looks)} pairs: a tip without insertion, with it, "
            "with the empty phantom, too",
            f"each >= {_LEAST_OF_A_KIND:.0%}",
            ", ".join(f"{share:.0%}" for share in shares),
            min(shares) >= _LEAST_OF_A_KIND,
        )


def _errors(rig: str, needles: Sequence[TrackedPair]) -> Iterator[Finding]:
    tips = [look for look in needles if look.tip is not None]
    errors = 1e3 * np.array([look.error for look in tips if look.known is not KnownInput.NOTHING])
    largest = 1e3 * max(look.error for look in tips)
    p95 = float(np.percentile(errors, 95))
    yield Finding(
        f"path_traced_errors_{rig}",
        f"path-traced, {rig}: error of {len(errors)} tips with insertion; largest of {len(tips)}",
        f"95 % <= {_LARGEST_P95[rig]:g} mm; <= {1e3 * WRONG:g} mm",
        f"95 % {p95:.2f} (median {np.median(errors):.2f}); {largest:.2f} mm",
        p95 <= _LARGEST_P95[rig] and largest <= 1e3 * WRONG,
    )
