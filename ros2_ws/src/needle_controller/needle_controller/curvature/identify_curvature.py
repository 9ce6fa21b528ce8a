"""The command `identify_curvature`: the needle's curvature from one pure insertion."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from needle_controller.curvature.curvature_checks import (
    check_independent_residuals,
    fit_checked,
)
from needle_controller.curvature.curvature_data import InsertionRecord, read_record
from needle_controller.curvature.curvature_fit import (
    CurvatureFit,
    CurvatureFitSettings,
    circle_curvature,
)
from needle_controller.curvature.tip_forecast import forecast_tip
from needle_core.commands.cli import (
    EXIT_DONE,
    EXIT_MISSED,
    JsonValue,
    finite_or_none,
    run_command,
    write_json,
)
from needle_core.commands.options import CommandParser, number, output_file
from needle_core.errors import UserError

DESCRIPTION = """\
Identify the curvature of the needle's path in a tissue, from an insertion without rotation.

The needle then follows a circle; the curvature kappa of that circle is plane_controller's parameter
`curvature` [1/m]. The command fits the most likely arc to the measured tips and prints its radius
1/kappa [mm] with its 95 % interval. Tips far from the arc are ignored as outliers.
"""

EPILOG = """\
measurement:
  Insert the needle without rotation by 60 mm or more, and measure a tip every mm. With +-1 mm of
  noise, an arc of 60 mm gives 1/kappa = 122 mm within about 6 % (one standard deviation), an arc of
  120 mm within 1 %. On the rig, record a bag of plane_controller with `preset: open_loop`.

input:
  bag: directory of a rosbag2 bag with needle/tip and joint_states
  CSV: columns x_m, y_m, z_m, as in the output of `ros2 run needle_tracker track_images`; rows with
      valid 0 are ignored.
      insertion_m (or --insertion, the same file as for track_images) gives the length of the arc at
      each tip, up to the slip between stage and needle, which is estimated from the tips. Without
      it each tip belongs to the nearest point of the arc.
      rotation_rad is checked like the rotation joint of a bag. Without it the tips are rejected if
      successive tips leave the arc by more than 0.05 mm (or 2.5 times --repeating-error-mm) and by
      more than their noise explains. This detects a rotation half-way of 20 deg or more at the
      noise of stereo_tracker, of 30 deg at +-1 mm over 120 mm, and hardly any at +-1 mm over 60 mm.

examples:
  ros2 run needle_controller identify_curvature bags/insertion
  ros2 run needle_controller identify_curvature tips.csv --insertion insertion.csv --json kappa.json
  ros2 run needle_controller identify_curvature bags/steered --until-mm 40
      only the insertion before the first rotation
  ros2 run needle_controller identify_curvature tips.csv --forecast-mm 98
      predict the tip at 98 mm, for example from tips of the first 50 mm, in tissue whose curvature
      varies by 0.4 1/m
  ros2 run needle_controller identify_curvature tips.csv --entry-std-mm inf --heading-std-deg inf
      with an unknown entry pose
  ros2 run needle_controller identify_curvature bags/insertion --from-mm 5
      without the first tips of stereo_tracker, which follow from the insertion, not from images

exit codes: 0 done; 1 the path cannot be distinguished from a straight line; 2 invalid input (the
base rotated, the insertion is too short, a value is not finite, ...); 130 interrupted
"""


_BOUNDS = {
    "from_mm": (0.0, 1000.0),
    "until_mm": (0.0, math.inf),
    "entry_std_mm": (0.001, math.inf),
    "heading_std_deg": (0.01, math.inf),
    "repeating_error_mm": (0.0, 100.0),
    "rotation_tolerance_deg": (0.0, 10.0),
    "forecast_mm": (1.0, 1000.0),
}
"""Bounds of the numeric options, whose names end in their units."""
_OUTLIER_WEIGHT = 0.5


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line, with numbers in mm and deg; raises UserError."""
    parser = CommandParser("identify_curvature", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("source", type=Path, metavar="BAG_OR_CSV", help="a bag's directory, or a CSV of tips")
    add("--insertion", type=Path, metavar="FILE", help="CSV name,insertion_m for a CSV of tips")
    add("--json", type=Path, metavar="FILE", help="also write the result as flat JSON")
    add("--from-mm", default="0", metavar="D", help="ignore smaller insertions [mm] (default: 0)")
    add("--until-mm", default="inf", metavar="D", help="ignore larger ones [mm] (default: all)")
    add(
        "--entry-std-mm",
        default="0.5",
        metavar="S",
        help="standard deviation of the entry point from rig's origin at insertion 0 [mm]; inf: "
        "unknown (default: 0.5)",
    )
    add(
        "--heading-std-deg",
        default="5",
        metavar="S",
        help="standard deviation of the heading at the entry from rig's z axis [deg]; inf: unknown "
        "(default: 5)",
    )
    add(
        "--repeating-error-mm",
        default="0.02",
        metavar="E",
        help="error common to all tips [mm], such as that of the calibration: more tips do not "
        "reduce it (default: 0.02)",
    )
    add(
        "--rotation-tolerance-deg",
        default="1",
        metavar="R",
        help="accepted rotation of the base during the insertion [deg] (default: 1)",
    )
    add(
        "--forecast-mm",
        metavar="D",
        help="predict the tip at this insertion [mm], without rotation",
    )
    options = parser.parse_args(arguments)
    options.json = output_file("--json", options.json)
    for name, (lower, upper) in _BOUNDS.items():
        if (text := getattr(options, name)) is not None:
            flag, unit = f"--{name.replace('_', '-')}", name.rpartition("_")[2]
            setattr(options, name, number(flag, text, lower, upper, unit))
    return options


def identify(options: argparse.Namespace) -> tuple[InsertionRecord, CurvatureFit]:
    """Read and check the tips, and fit the curvature; raises UserError."""
    record = read_record(options.source, options.insertion)
    record = record.between(options.from_mm * 1e-3, options.until_mm * 1e-3)
    record.check_pure(math.radians(options.rotation_tolerance_deg))
    settings = CurvatureFitSettings(
        entry_std=options.entry_std_mm * 1e-3,
        heading_std=math.radians(options.heading_std_deg),
        repeating_error=options.repeating_error_mm * 1e-3,
    )
    try:
        fit = fit_checked(record.tips, record.insertion, settings)
        if record.rotation is None:
            check_independent_residuals(fit.residuals, settings.repeating_error)
        return record, fit
    except UserError as error:
        raise UserError(f"{options.source}: {error}") from error


def summary(record: InsertionRecord, fit: CurvatureFit) -> dict[str, JsonValue]:
    """Return the result as a flat object."""
    low, high = (float(radius) for radius in fit.radius_interval())
    if record.insertion is not None:
        arc = float(np.max(record.insertion))
    else:
        arc = float(np.linalg.norm(record.tips[-1] - record.tips[0]))
    return {
        "radius_mm": finite_or_none(1e3 * float(fit.radius)),
        "radius_low_mm": 1e3 * low,
        "radius_high_mm": finite_or_none(1e3 * high),
        "curvature_per_m": float(fit.curvature),
        "curvature_std_per_m": float(fit.std),
        "circle_radius_mm": 1e3 / float(circle_curvature(record.tips)),
        "arc_mm": 1e3 * arc,
        "tips": len(record.tips),
        "outliers": int(np.sum(fit.weights < _OUTLIER_WEIGHT)),
        "measurement_std_mm": 1e3 * float(fit.measurement_std),
        "slip": float(fit.slip) if record.insertion is not None else None,
        "slip_std": float(fit.slip_std) if record.insertion is not None else None,
        "insertion_known": record.insertion is not None,
        "rotation_known": record.rotation is not None,
        "warnings": "; ".join(fit.warnings),
    }


def _forecast(
    options: argparse.Namespace, record: InsertionRecord, fit: CurvatureFit
) -> dict[str, JsonValue]:
    """Return the predicted tip and half the widths of its 95 % intervals, if requested."""
    names = [f"forecast_{what}_mm" for what in ("x", "y", "z", "x_95", "y_95", "z_95")]
    if options.forecast_mm is None:
        return dict.fromkeys(names)
    ahead = forecast_tip(record.tips, fit, 1e-3 * options.forecast_mm)
    values = 1e3 * np.concatenate(ahead)
    return dict(zip(names, values.tolist(), strict=True))


def main(args: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = sys.argv[1:] if args is None else args
    return run_command(lambda: _run(arguments))


def _run(arguments: Sequence[str]) -> int:
    options = parse(arguments)
    record, fit = identify(options)
    values = summary(record, fit)
    for warning in fit.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if record.rotation is None:
        print(
            "warning: the rotation of the base is not recorded; the tips follow one arc",
            file=sys.stderr,
        )
    values |= _forecast(options, record, fit)
    write_json(options.json, values)
    low, high = (1e3 * float(radius) for radius in fit.radius_interval())
    interval = f"{low:.1f} to {high:.1f} mm" if math.isfinite(high) else f"more than {low:.1f} mm"
    print(f"1/kappa = {1e3 * float(fit.radius):.1f} mm (95 %: {interval})")
    print(f"curvature: {float(fit.curvature):.4g}  # 1/m, +- {float(fit.std):.2g}")
    print(
        f"{values['tips']} tips over {float(values['arc_mm'] or 0.0):.1f} mm, "
        f"{values['outliers']} of them outliers, noise {1e3 * float(fit.measurement_std):.3f} mm"
    )
    if record.insertion is not None:
        slip, std = 100.0 * float(fit.slip), 100.0 * float(fit.slip_std)
        print(f"the stage moved {slip:.1f} % farther than the needle went in, +- {std:.1f} %")
    if options.forecast_mm is not None:
        x, y, z, *widths = (values[name] for name in values if name.startswith("forecast_"))
        print(
            f"at {options.forecast_mm:g} mm the tip will be at x = {x:.2f}, y = {y:.2f}, "
            f"z = {z:.2f} mm (95 %: +- {widths[0]:.2f}, {widths[1]:.2f}, {widths[2]:.2f} mm)"
        )
    if not math.isfinite(high):
        print("the tips do not distinguish this path from a straight line: insert deeper")
        return EXIT_MISSED
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
