"""Forecasts of real insertions: how far off, and how often within their 95 % intervals.

git clone https://github.com/maribernardes/trajcontrol_lisa
python -m campaign.steering.real_insertions trajcontrol_lisa/data/*/exp_*_00*.csv

Files are those of that repository: columns `Tip x`, `Tip y`, `Tip z` [mm], the needle going in
along -y from y = 0.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from needle_controller.curvature.curvature_checks import fit_checked
from needle_controller.curvature.curvature_fit import CurvatureFitSettings
from needle_controller.curvature.tip_forecast import forecast_tip
from needle_controller.model.arrays import Array
from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.errors import UserError

GIVEN, AHEAD = 0.050, 0.098
"""Largest depth of the given tips, and depth of the forecast [m]."""
_NEAR = 0.004
_COLUMNS = ("Tip x", "Tip y", "Tip z", "Tip sec", "Tip nanosec")


def tips_of(path: Path) -> Array:
    """Return the tips of a file from the entry on, (K, 3) [m]: across x and z, and depth.

    Raises
    ------
    UserError
        If the file lacks these columns.
    """
    with path.open(encoding="utf-8", newline="") as stream:
        rows = [
            {name.strip(): text for name, text in row.items()} for row in csv.DictReader(stream)
        ]
    if not rows or not set(_COLUMNS) <= rows[0].keys():
        raise UserError(f"{path}: expected columns {', '.join(_COLUMNS)}")
    # A repeated row is not a new measurement; zeros precede the first one.
    values = dict.fromkeys(tuple(float(row[name]) for name in _COLUMNS) for row in rows)
    x, y, z = np.array([value[:3] for value in values if any(value[:2])]).T * 1e-3
    inside = y <= 0.0
    across = np.stack([x, z], axis=-1)[inside]
    return np.column_stack([across - np.mean(across[:3], axis=0), -y[inside]])


def position_at(tips: Array, depth: float) -> Array | None:
    """Return the position at a depth, (2,) [m], by a line through the nearby tips, or None."""
    near = np.abs(tips[:, 2] - depth) < _NEAR
    if np.sum(near) < 3 or np.max(tips[:, 2]) < depth - 0.0015:
        return None
    line = np.polyfit(tips[near, 2] - depth, tips[near, :2], 1)
    return np.asarray(line[1])


def compare(tips: Array, truth: Array) -> tuple[float, float, bool]:
    """Return the errors of forecast and parabola [m], and whether x and y are in the interval.

    Parameters
    ----------
    tips : ndarray, shape (K, 3)
        See `tips_of`.
    truth : ndarray, shape (2,)
        Position at the depth of the forecast [m].
    """
    given = tips[tips[:, 2] <= GIVEN]
    fit = fit_checked(given, None, CurvatureFitSettings(repeating_error=2e-5))
    tip, interval = forecast_tip(given, fit, AHEAD)
    # The forecast is for a length of path, the truth for a depth.
    slope = tip[:2] / tip[2]
    off = tip[:2] + slope * (AHEAD - tip[2]) - truth
    parabola = np.polyfit(given[:, 2], given[:, :2], 2)
    plain = parabola[0] * AHEAD**2 + parabola[1] * AHEAD + parabola[2] - truth
    inside = bool(np.all(np.abs(off) <= interval[:2]))
    return float(np.linalg.norm(off)), float(np.linalg.norm(plain)), inside


def _run(files: Sequence[str]) -> int:
    insertions = [tips_of(Path(file)) for file in files]
    known = [(tips, position_at(tips, AHEAD)) for tips in insertions]
    compared = [compare(tips, truth) for tips, truth in known if truth is not None]
    if not compared:
        raise UserError("no file has an insertion to 98 mm; give exp_*_00*.csv")
    off, plain, inside = (np.array(column) for column in zip(*compared, strict=True))
    print(f"{len(compared)} insertions of {len(files)} files, from {GIVEN * 1e3:.0f} mm to 98 mm")
    print(
        f"forecast off by {1e3 * np.median(off):.2f} mm, 90 %: {1e3 * np.percentile(off, 90):.2f}"
    )
    print(f"parabola off by {1e3 * np.median(plain):.2f} mm")
    print(f"both coordinates within their 95 % intervals: {np.mean(inside):.1%}")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(run_command(lambda: _run(sys.argv[1:])))
