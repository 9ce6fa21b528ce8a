"""`ros2 run needle_tracker register_tracker`: registration of a tracker from paired points."""

from __future__ import annotations

import dataclasses
import math
import sys
import warnings
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_core.commands.cli import EXIT_DONE, run_command, write_json
from needle_core.commands.csv_files import read_rows
from needle_core.commands.options import CommandParser, number, output_file
from needle_core.errors import UserError
from needle_core.settings.bounds import check_bounds
from needle_tracker.optics.calibration import pose_matrix
from needle_tracker.tracked.registration import Registration, write_registration

Array = NDArray[np.float64]

LARGEST_ERROR, LARGEST_TARGET_ERROR = 1e-3, 3e-3
"""Limits of the root mean square fiducial error, and of the error at a point left out [m]."""
_LEAST_DISTANCE, _LEAST_WIDTH = 5e-3, 3e-3  # between two points, and of all points from a line [m]
_LEAST_STD = 1e-5  # least standard deviation of a measured coordinate [m]
_POINT_COLUMNS = tuple(f"{frame}_{axis}_mm" for frame in ("rig", "tracker") for axis in "xyz")
_PIVOT_COLUMNS = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
_DESCRIPTION = f"""\
Register a tracker to the rig, and calibrate the tip of its sensor.

POINTS.csv has the columns name,{",".join(_POINT_COLUMNS[:3])},
{",".join(_POINT_COLUMNS[3:])}: places in `rig` (x up, z along the insertion,
origin at the entry point) and as the tracker measures them. Take 4 or more, better 6, around the
needle's path, and no two that could be exchanged, such as corners of a square.

--pivot has the columns {",".join(_PIVOT_COLUMNS)}: poses of the sensor while it turns about
the needle's tip, which stays in place. Without it, the sensor is at the tip.
"""


class Fit(NamedTuple):
    """T_rig_tracker of paired points, and their root mean square distance in it [m]."""

    rotation: Array
    translation: Array
    error: float


def fit(rig: Array, tracker: Array) -> Fit:
    """Return the least-squares transform between points, (N, 3) [m], by Kabsch's method."""
    to, origin = rig.mean(axis=0), tracker.mean(axis=0)
    with warnings.catch_warnings():
        # A trial exchange of points may leave the rotation undetermined, which its error reveals.
        warnings.simplefilter("ignore", UserWarning)
        rotation = Rotation.align_vectors(rig - to, tracker - origin)[0].as_matrix()
    translation = to - rotation @ origin
    residuals = rig - tracker @ rotation.T - translation
    return Fit(rotation, translation, math.sqrt(np.sum(residuals**2) / len(rig)))


def register(names: list[str], rig: Array, tracker: Array) -> tuple[Registration, Fit, Array]:
    """Return the registration of paired points, their fit, and the errors at points left out [m].

    Parameters
    ----------
    names : list of str
        Name of each point.
    rig, tracker : ndarray, shape (N, 3)
        The points [m].

    Raises
    ------
    UserError
        Too few or degenerate points, points that were exchanged, mirrored or scaled, one that does
        not fit, or an error over its limit.
    """
    _check_layout(names, rig, tracker)
    found = fit(rig, tracker)
    without = [(np.delete(rig, k, 0), np.delete(tracker, k, 0)) for k in range(len(names))]
    fits = {k: fit(*w) for k, w in enumerate(without) if len(names) > 3 and _width(w[0]) > 1e-3}
    left_out = np.array(
        [np.linalg.norm(rig[k] - f.rotation @ tracker[k] - f.translation) for k, f in fits.items()]
    )
    worst = float(np.max(left_out, initial=0.0))
    if found.error > LARGEST_ERROR or worst > LARGEST_TARGET_ERROR:
        raise UserError(
            f"{_likely_cause(names, rig, tracker, fits)}: fiducial error {_mm(found.error)}, limit "
            f"{_mm(LARGEST_ERROR)}; error at a point left out {_mm(worst)}, limit "
            f"{_mm(LARGEST_TARGET_ERROR)}"
        )
    # Variance of a coordinate, by Student's t: few points do not determine it well.
    count, centroid = len(names), rig.mean(axis=0)
    variance = max(count * found.error**2 / (3 * count - 8), _LEAST_STD**2)
    arms = rig - centroid
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) * variance / count
    covariance[3:, 3:] = variance * np.linalg.inv(np.sum(arms**2) * np.eye(3) - arms.T @ arms)
    pose = pose_matrix(found.rotation, found.translation)
    registration = Registration(pose, centroid, covariance, np.zeros(3), math.sqrt(variance))
    return registration, found, left_out


def pivot(positions: Array, quaternions: Array) -> tuple[Array, float]:
    """Return the tip in the sensor's frame [m], and the standard deviation of a coordinate [m].

    Solves R_i tip - place = -t_i for the tip and its place in the tracker's frame.

    Parameters
    ----------
    positions, quaternions : ndarray, shape (N, 3), (N, 4)
        Poses of the sensor [m], [x, y, z, w].

    Raises
    ------
    UserError
        Too few poses, a quaternion without unit length, too little rotation, or a tip that moved.
    """
    check_bounds("number of poses in --pivot", len(positions), 6, math.inf, "-")
    for norm in np.linalg.norm(quaternions, axis=1):
        check_bounds("norm of a quaternion in --pivot", float(norm), 0.99, 1.01, "-")
    turns = Rotation.from_quat(quaternions).as_matrix()
    minus = np.broadcast_to(-np.eye(3), turns.shape)
    rows = np.concatenate([turns, minus], axis=2).reshape(-1, 6)
    solution, _, _, singular = np.linalg.lstsq(rows, -positions.ravel(), rcond=None)
    residual = rows @ solution + positions.ravel()
    std = max(float(np.sqrt(np.sum(residual**2) / (len(residual) - 6))), _LEAST_STD)
    if std > LARGEST_ERROR:
        raise UserError(f"--pivot: the tip moved by {_mm(std)}, limit {_mm(LARGEST_ERROR)}")
    offset_std = std / max(float(singular[-1]), 1e-9)
    if offset_std > LARGEST_ERROR:
        raise UserError(
            "--pivot: the sensor turned too little, or about one axis: the tip's standard "
            f"deviation is {_mm(offset_std)}, limit {_mm(LARGEST_ERROR)}"
        )
    return solution[:3], std


def _check_layout(names: list[str], rig: Array, tracker: Array) -> None:
    """Check that the points determine a transform, and reveal an exchange of two of them."""
    check_bounds("number of points", len(names), 3, math.inf, "-")
    for where, points in (("rig", rig), ("tracker", tracker)):
        for i, j in combinations(range(len(names)), 2):
            apart = float(np.linalg.norm(points[i] - points[j]))
            name = f"distance of {names[i]} and {names[j]} in {where}"
            check_bounds(name, 1e3 * apart, 1e3 * _LEAST_DISTANCE, math.inf, "mm")
        if _width(points) < _LEAST_WIDTH:
            raise UserError(f"the points in {where} are within {_mm(_width(points))} of a line")
    for i, j in combinations(range(len(names)), 2):
        if fit(rig, _exchanged(rig, i, j)).error < LARGEST_ERROR:
            raise UserError(
                f"an exchange of {names[i]} and {names[j]} would not be noticed: add a point"
            )


def _likely_cause(names: list[str], rig: Array, tracker: Array, fits: dict[int, Fit]) -> str:
    """Return the mistake without which the points fit."""
    ratio = np.linalg.norm(tracker - tracker.mean(0)) / np.linalg.norm(rig - rig.mean(0))
    mistakes = {
        f"distances in tracker are {ratio:.4g} times those in rig": tracker / ratio,
        "an axis of the tracker is mirrored": tracker * (-1.0, 1.0, 1.0),
        **{
            f"{names[i]} and {names[j]} are exchanged": _exchanged(tracker, i, j)
            for i, j in combinations(range(len(names)), 2)
        },
    }
    errors = {text: fit(rig, points).error for text, points in mistakes.items()}
    errors |= {f"{names[k]} does not fit the others": other.error for k, other in fits.items()}
    text = min(errors, key=errors.__getitem__)
    return text if errors[text] < LARGEST_ERROR else "the points do not fit"


def _width(points: Array) -> float:
    """Return the root mean square distance of points from the closest line [m]."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.hypot(spread[1], spread[2]) / math.sqrt(len(points)))


def _exchanged(points: Array, i: int, j: int) -> Array:
    order = np.arange(len(points))
    order[[i, j]] = j, i
    return points[order]


def _mm(length: float) -> str:
    return f"{1e3 * length:.2f} mm"


def _read(path: Path, columns: tuple[str, ...]) -> tuple[list[str], Array]:
    """Return the names and numbers of a CSV, (N, C); a `UserError` gives line and column."""
    rows = read_rows(path, columns)
    names = [row.get("name") or f"point {count}" for count, (_, row) in enumerate(rows, 1)]
    values = [
        number(f"{where}: {column}", row[column], -1e4, 1e4, "-")
        for where, row in rows
        for column in columns
    ]
    return names, np.array(values).reshape(-1, len(columns))


def main() -> int:
    """Run the command line and return its exit code."""
    return run_command(_main)


def _main() -> int:
    parser = CommandParser("register_tracker", _DESCRIPTION, "")
    parser.add_argument("points", metavar="POINTS.csv", type=Path, help="paired points")
    parser.add_argument("--pivot", metavar="FILE.csv", type=Path, help="poses about the tip")
    parser.add_argument("--output", metavar="FILE.yaml", required=True, help="registration file")
    parser.add_argument("--json", metavar="FILE", help="also write the results as flat JSON")
    options = parser.parse_args()
    names, numbers = _read(options.points, _POINT_COLUMNS)
    found, fitted, left_out = register(names, 1e-3 * numbers[:, :3], 1e-3 * numbers[:, 3:])
    if options.pivot:
        _, poses = _read(options.pivot, _PIVOT_COLUMNS)
        offset, std = pivot(1e-3 * poses[:, :3], poses[:, 3:])
        found = dataclasses.replace(found, tip_offset=offset, sensor_std=std)
    results = {
        "points": len(names),
        "fiducial_error_mm": 1e3 * fitted.error,
        "target_error_mm": 1e3 * math.sqrt(np.mean(left_out**2)) if len(left_out) else None,
        "std_at_entry_mm": 1e3 * found.std_at(np.zeros(3)),
        "std_at_100_mm_mm": 1e3 * found.std_at(np.array([0.0, 0.0, 0.1])),
        "tip_offset_mm": 1e3 * float(np.linalg.norm(found.tip_offset)),
        "sensor_std_mm": 1e3 * found.sensor_std,
    }
    lines = [f"{key}: {value:.4g}" for key, value in results.items() if value is not None]
    output = output_file("--output", options.output)
    write_registration(output, found, lines)
    print("\n".join(lines))
    write_json(output_file("--json", options.json), results)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
