"""Summary of a run over image files: what the views showed, and errors against the truth."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from needle_core.commands.cli import JsonValue
from needle_tracker.answers.annotation import IN_ENTRY_ZONE, missing, shows_end, shows_shaft
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.optics.calibration import SIDES

Array = npt.NDArray[np.float64]

_INSIDE_95 = 7.814728
"""95 % quantile of chi-squared with three degrees of freedom."""


class DetectionCounts:
    """Counts of detected ends and shafts, except in the entry zone."""

    def __init__(self) -> None:
        self._pairs = 0
        self._missing: Counter[str] = Counter()
        # By the keys of `track_images --json`.
        ends = {f"{side}_end_seen": 0 for side in SIDES}
        self._seen = {**ends, **{f"{side}_shaft_seen": 0 for side in SIDES}}

    def add(self, measured: Measurement) -> None:
        """Count the result of a pair."""
        cause = missing(measured)
        if cause:
            self._missing[cause] += 1
        if cause == IN_ENTRY_ZONE:
            return
        self._pairs += 1
        for side, end in zip(SIDES, measured.ends, strict=True):
            self._seen[f"{side}_end_seen"] += shows_end(end)
            self._seen[f"{side}_shaft_seen"] += shows_shaft(end)

    def describe(self) -> str:
        """Return the counts as text."""
        lines = [
            f"  {side:5}: end seen in {self._seen[f'{side}_end_seen']} of {self._pairs} pairs, "
            f"shaft in {self._seen[f'{side}_shaft_seen']}"
            for side in SIDES
        ]
        lines += [f"  no tip {n:6d} x  {cause}" for cause, n in self._missing.most_common()]
        if self._missing:
            lines.append("  docs/own_rig.md gives a remedy for each reason")
        return "\n".join(lines)

    def figures(self) -> dict[str, JsonValue]:
        """Return the counts by the keys of `track_images --json`."""
        return {**self._seen}


class TruthComparison:
    """Comparison of tips with the true end of the needle, pair by pair.

    Parameters
    ----------
    tips : mapping of str to (sequence of 3 floats, or None)
        True tip in `rig` [m] by name; None if the images show no needle.
    """

    def __init__(self, tips: Mapping[str, Sequence[float] | None]) -> None:
        self._tips = tips
        self._errors: list[Array] = []
        self._squares: list[float] = []
        self._missed = self._false = self._without_truth = 0

    def add(self, names: Sequence[str], measured: Measurement) -> None:
        """Add the result of a pair by any of its names; a tip in the entry zone does not count."""
        key = next((name for name in names if name in self._tips), None)
        if key is None:
            self._without_truth += 1
            return
        true, tip = self._tips[key], measured.tip
        if tip is None or measured.state is TrackState.ENTRY:
            self._missed += true is not None
            return
        if true is None:
            self._false += 1
            return
        error = np.asarray(tip.position - true)
        self._errors.append(error)
        self._squares.append(float(error @ np.linalg.solve(tip.covariance, error)))

    def figures(self) -> dict[str, JsonValue]:
        """Return the figures by the keys of `track_images --json`; NaN if unknown."""
        errors = np.array(self._errors or [np.full(3, np.nan)])
        squares = np.array(self._squares or [np.nan])
        size = 1e3 * np.linalg.norm(errors, axis=1)
        rms = 1e3 * np.sqrt(np.mean(errors**2, axis=0))
        return {
            "compared": len(self._errors),
            "missed": self._missed,
            "tips_without_needle": self._false,
            "without_truth": self._without_truth,
            "error_rms_mm": math.sqrt(float(np.mean(size**2))),
            "error_p95_mm": float(np.percentile(size, 95.0)),
            "error_max_mm": float(np.max(size)),
            "error_sigmas": math.sqrt(float(np.mean(squares)) / 3.0),
            "inside_95": float(np.mean(squares <= _INSIDE_95)) if self._errors else math.nan,
            **{f"error_{axis}_rms_mm": float(rms[i]) for i, axis in enumerate("xyz")},
        }

    def describe(self) -> str:
        """Return the figures as text."""
        figures = self.figures()
        lines = [
            f"against the truth: {figures['compared']} tips, {figures['missed']} needles without "
            f"a tip, {figures['tips_without_needle']} tips without a needle"
        ]
        if figures["compared"]:
            axes = ", ".join(f"{axis} {figures[f'error_{axis}_rms_mm']:.3f}" for axis in "xyz")
            lines += [
                f"  error  {figures['error_rms_mm']:.3f} mm rms ({axes}), "
                f"{figures['error_p95_mm']:.3f} mm (95th percentile), "
                f"{figures['error_max_mm']:.3f} mm at worst",
                f"  that is {figures['error_sigmas']:.2f} claimed standard deviations (ideal: 1); "
                f"{figures['inside_95']:.1%} lie within the claimed 95 % region",
            ]
        return "\n".join(lines)
