"""Shaft and end as each view shows them, and what was missing where a pair gave no tip."""

from __future__ import annotations

import dataclasses
from collections import Counter

from needle_core.commands.cli import JsonValue
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.filter.measurement import Measurement, NoTip, TrackState
from needle_tracker.optics.calibration import SIDES

CLEAR = 0.5
"""Expected ends, or mean probability of shaft, above which a view shows them."""
IN_ENTRY_ZONE = "in the entry zone"
_BY_VIEWS = {
    (False, False): NoTip.NOTHING.value,
    (True, False): "end seen in the left view only",
    (False, True): "end seen in the right view only",
    (True, True): "both views show an end but they do not meet",
}
HELP = {
    _BY_VIEWS[False, False]: "light, floor, focus; swapped cameras; `check_calibration`",
    _BY_VIEWS[True, False]: "light, floor and focus of the right view; what lies over the end",
    _BY_VIEWS[False, True]: "light, floor and focus of the left view; what lies over the end",
    _BY_VIEWS[True, True]: "swapped cameras; images of one exposure; `check_calibration`",
    NoTip.UNCONFIRMED.value: (
        "the insertion; is zero the needle's tip at the entry? move the needle"
    ),
    NoTip.UNCERTAIN.value: "what lies over the end; cameras farther apart",
}
"""Causes that a person can do something about, and what helps, as in docs/own_rig.md."""


def shows_end(end: ImageEnd | None) -> bool:
    """Return whether a view shows the needle's end."""
    return end is not None and end.ends > CLEAR


def shows_shaft(end: ImageEnd | None) -> bool:
    """Return whether a view shows the needle's shaft."""
    return end is not None and end.shaft > CLEAR


def missing(measured: Measurement) -> str:
    """Return why a pair gave no tip, empty where it did; a tip from the stage alone is none."""
    if measured.state is TrackState.ENTRY:
        return IN_ENTRY_ZONE
    if measured.tip is not None:
        return ""
    if measured.reason != NoTip.NOTHING:
        return str(measured.reason)
    left, right = measured.ends
    return _BY_VIEWS[shows_end(left), shows_end(right)]


@dataclasses.dataclass
class SeenCounts:
    """Counts of what pairs showed, but for those that the entry zone excuses."""

    pairs: int = 0
    ends: Counter[str] = dataclasses.field(default_factory=Counter)
    shafts: Counter[str] = dataclasses.field(default_factory=Counter)
    missing: Counter[str] = dataclasses.field(default_factory=Counter)

    def add(self, measured: Measurement) -> None:
        """Take what a pair gave."""
        cause = missing(measured)
        if cause:
            self.missing[cause] += 1
        if cause == IN_ENTRY_ZONE:
            return
        self.pairs += 1
        for side, end in zip(SIDES, measured.ends, strict=True):
            self.ends[side] += shows_end(end)
            self.shafts[side] += shows_shaft(end)

    def describe(self) -> str:
        """Return the counts as a person reads them, and what helps against the commonest cause."""
        lines = [
            f"  {side:5}: end seen in {self.ends[side]} of {self.pairs} pairs, "
            f"shaft in {self.shafts[side]}"
            for side in SIDES
        ]
        lines += [f"  no tip {n:6d} x  {cause}" for cause, n in self.missing.most_common()]
        for cause, _ in self.missing.most_common():
            if cause in HELP:
                lines.append(f"  most often `{cause}`, helps: {HELP[cause]} (docs/own_rig.md)")
                break
        return "\n".join(lines)

    def figures(self) -> dict[str, JsonValue]:
        """Return the counts, flat, by the names of `track_images --json`."""
        seen = {f"{side}_end_seen": self.ends[side] for side in SIDES}
        return {**seen, **{f"{side}_shaft_seen": self.shafts[side] for side in SIDES}}
