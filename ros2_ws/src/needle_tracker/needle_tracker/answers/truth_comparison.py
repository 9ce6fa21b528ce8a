"""Errors of tips against the truth, in mm and in sigmas."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from needle_core.commands.cli import JsonValue
from needle_tracker.filter.measurement import Measurement, TrackState
from needle_tracker.sources.image_files import read_numbers

Array = npt.NDArray[np.float64]

_INSIDE_95 = 7.814728
"""Square of a normal error of three axes, in sigmas, that 95 % stay within."""


class TruthComparison:
    """Compares tips with where the needle's end really was, pair by pair.

    Parameters
    ----------
    tips : mapping of str to (ndarray, shape (3,), or None)
        True tip in `rig` [m] by name; None where the images show no needle.
    """

    def __init__(self, tips: Mapping[str, Array | None]) -> None:
        self._tips = tips
        self._errors: list[Array] = []
        self._squares: list[float] = []
        self._missed = self._false = self._untold = 0

    def add(self, names: Sequence[str], measured: Measurement) -> None:
        """Take what a pair of any of these names gave; a tip from the stage alone is none."""
        key = next((name for name in names if name in self._tips), None)
        if key is None:
            self._untold += 1
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
        """Return the figures, by the names of `track_images --json`; NaN where nothing tells."""
        errors = np.array(self._errors or [np.full(3, np.nan)])
        squares = np.array(self._squares or [np.nan])
        size = 1e3 * np.linalg.norm(errors, axis=1)
        rms = 1e3 * np.sqrt(np.mean(errors**2, axis=0))
        return {
            "compared": len(self._errors),
            "missed": self._missed,
            "tips_without_needle": self._false,
            "without_truth": self._untold,
            "error_rms_mm": math.sqrt(float(np.mean(size**2))),
            "error_p95_mm": float(np.percentile(size, 95.0)),
            "error_max_mm": float(np.max(size)),
            "error_sigmas": math.sqrt(float(np.mean(squares)) / 3.0),
            "inside_95": float(np.mean(squares <= _INSIDE_95)) if self._errors else math.nan,
            **{f"error_{axis}_rms_mm": float(rms[i]) for i, axis in enumerate("xyz")},
        }

    def describe(self) -> str:
        """Return the figures as a person reads them."""
        seen = self.figures()
        lines = [
            f"against the truth: {seen['compared']} tips, {seen['missed']} needles without a tip, "
            f"{seen['tips_without_needle']} tips without a needle"
        ]
        if seen["compared"]:
            axes = ", ".join(f"{axis} {seen[f'error_{axis}_rms_mm']:.3f}" for axis in "xyz")
            lines += [
                f"  error  {seen['error_rms_mm']:.3f} mm rms ({axes}), "
                f"{seen['error_p95_mm']:.3f} mm (95th percentile), "
                f"{seen['error_max_mm']:.3f} mm at worst",
                f"  that is {seen['error_sigmas']:.2f} of the claimed standard deviations (1 is as "
                f"claimed); {seen['inside_95']:.1%} lie within what should hold 95 %",
            ]
        return "\n".join(lines)


def read_truth(path: Path) -> dict[str, Array | None]:
    """Read a CSV of true tips by name, with the columns name, x_m, y_m, z_m.

    Parameters
    ----------
    path : Path
        The file, such as `render_images` writes; other columns are passed over.

    Returns
    -------
    dict
        Name to the tip in `rig` [m], None where the fields are empty: no needle.

    Raises
    ------
    UserError
            As `image_files.read_numbers`.
    """
    read = read_numbers("--truth", path, ("x_m", "y_m", "z_m"))
    return {name: None if tip is None else np.array(tip) for name, tip in read.items()}
