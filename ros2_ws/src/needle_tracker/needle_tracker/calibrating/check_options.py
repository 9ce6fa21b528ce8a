"""The command line of `check_calibration`, and what it prints."""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from needle_core.commands.cli import JsonValue
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.settings.bounds import check_bounds
from needle_tracker.calibrating.calibration_check import (
    CAMERAS,
    NOTHING_SHOWN,
    CheckResult,
    Deviation,
)
from needle_tracker.calibrating.rig_model import unit_of

_DESCRIPTION = """\
Check a stereo calibration with a ChArUco board of known place: a camera turned by 0.02 deg, an
index off by 0.01 or another surface height are silent (both rays still meet) and cost 0.1 to
0.7 mm. Prints what differs, by how much and what it does to tips.

The session file is that of calibrate_stereo (see there): board and places. For a check lay the
board flat on the surface and, tilted, at a known place under it, and give each place the `sigma`
that it is really known to. A place given wrong looks like both cameras turned.

Recorded images: --left and --right, folders paired by name; an image whose name is no place of the
session is taken for a board held freely in air, which says little. Live: --live NAME takes pairs
from stereo/{left,right}/image_raw; the board stands still at the session's place NAME.
"""
_EPILOG = """\
examples:
  ros2 run needle_tracker check_calibration --calibration rig.yaml --session S.yaml --left L --right R
  ros2 run needle_tracker check_calibration --calibration rig.yaml --session S.yaml --live under_wedge

exit codes: 0 OK; 1 NOT OK, or this target cannot show it; 2 bad input, no images or no board;
130 interrupted
"""  # noqa: E501 - command lines stay whole


def parse(arguments: Sequence[str]) -> Namespace:
    """Return the options of a command line (without the program's name); `limit` is in metres.

    Raises
    ------
    UserError
        Anything that cannot be run as asked.
    """
    given = _parser().parse_args(arguments)
    if (given.live is None) != (given.left is not None and given.right is not None):
        raise UserError("wants either --left and --right, or --live; see --help")
    if given.live is not None and (given.left is not None or given.right is not None):
        raise UserError("--live takes its images from topics: no --left, no --right")
    for name, lower, upper, unit in (
        ("count", 1, 1000, "pairs"),
        ("timeout", 0.1, 3600.0, "s"),
        ("pair_tolerance", 0.0, 0.1, "s"),
        ("limit_mm", 0.001, 10.0, "mm"),
    ):
        check_bounds(f"--{name.replace('_', '-')}", getattr(given, name), lower, upper, unit)
    given.limit = 1e-3 * given.limit_mm
    return given


def report(result: CheckResult) -> str:
    """Return a check as a person reads it."""
    lines = [
        f"corners miss by {result.reprojection_px:.3f} px rms (expected "
        f"{math.sqrt(2.0) * result.corner_sigma_px:.3f})"
    ]
    lines += [f"found: {_words(deviation)}" for deviation in result.deviations]
    explained = math.isfinite(result.tip_error)
    if explained and not result.deviations:
        lines.append("found: nothing that differs from the calibration")
    if {d.cause for d in result.deviations} >= set(CAMERAS):
        lines.append("both cameras turned: or the target is not where the session says")
    if explained:
        unseen = result.unseen_tip_error
        lines.append(
            f"tips in the phantom, 95 %: off by {1e3 * result.tip_error:.3f} mm; with this target "
            + (
                f"errors below {1e3 * unseen:.3f} mm cannot be seen"
                if unseen < NOTHING_SHOWN
                else "other errors cannot be seen, however large"
            )
        )
    lines += [f"NOT OK: {problem}" for problem in result.problems]
    if result.ok:
        lines.append("OK")
    return "\n".join(lines)


def figures(result: CheckResult) -> dict[str, JsonValue]:
    """Return a check's figures, flat, for --json; null for a cause that was not found."""
    unseen = result.unseen_tip_error if result.unseen_tip_error < NOTHING_SHOWN else math.nan
    values: dict[str, JsonValue] = {
        "ok": result.ok,
        "tip_error_p95_mm": 1e3 * result.tip_error,
        "unseen_tip_error_p95_mm": 1e3 * unseen,
        "corner_sigma_px": result.corner_sigma_px,
        "reprojection_rms_px": result.reprojection_px,
        "problem": "; ".join(result.problems) or None,
    }
    found = {deviation.cause: deviation for deviation in result.deviations}
    for cause in result.causes:
        scale, unit = unit_of(cause)
        deviation = found.get(cause)
        key = f"{cause.replace('.', '_')}{'_error' if cause not in CAMERAS else ''}"
        key += unit and f"_{unit}"
        values[key] = None if deviation is None else scale * deviation.size
        values[f"sigma_{key}"] = None if deviation is None else scale * deviation.sigma
    return values


def _words(deviation: Deviation) -> str:
    scale, unit = unit_of(deviation.cause)
    size, sigma = scale * deviation.size, scale * deviation.sigma
    effect = f"by itself {1e3 * deviation.tip_error:.3f} mm at the tip"
    if deviation.cause in CAMERAS:
        side = deviation.cause.split("_")[0]
        return f"{side} camera turned by {size:.4f} +- {sigma:.4f} deg (or moved); {effect}"
    name = deviation.cause.replace("_", " ").replace(".", " ")
    return (
        f"{name} is {size:+.4f} +- {sigma:.4f}{unit and f' {unit}'} off the calibration's; {effect}"
    )


def _parser() -> CommandParser:
    parser = CommandParser("check_calibration", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add("--calibration", type=Path, required=True, metavar="FILE", help="what is checked")
    add("--session", type=Path, required=True, metavar="FILE", help="board and places (YAML)")
    add("--left", type=Path, metavar="DIR", help="images of the left camera")
    add("--right", type=Path, metavar="DIR", help="images of the right camera")
    add("--live", metavar="NAME", help="take images from topics, the board at this place")
    add("--count", type=int, default=10, metavar="N", help="pairs to take live (10)")
    add("--timeout", type=float, default=10.0, metavar="S", help="wait for them so long (10 s)")
    add("--pair-tolerance", type=float, default=0.0, metavar="S", help="of left and right (0 s)")
    add("--limit-mm", type=float, default=0.15, metavar="MM", help="accepted tip error (0.15)")
    add("--json", type=Path, metavar="FILE", help="also write the figures as flat JSON")
    return parser
