"""`ros2 run needle_tracker track_images`: the tracker on image files, without ROS nodes."""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from needle_core.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_core.commands.csv_files import read_insertions, read_lengths
from needle_core.commands.options import CommandParser, output_file
from needle_core.errors import UserError
from needle_core.files.file_access import make_folder, write_text
from needle_core.settings.parameter_fields import from_values
from needle_core.settings.parameter_files import missing_section_warning, read_sections, values_for
from needle_tracker.answers.annotation import annotate, missing
from needle_tracker.answers.pair_answers import SUSPICION, SwapWatch
from needle_tracker.answers.run_summary import DetectionCounts, TruthComparison
from needle_tracker.filter.measurement import Measurement
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.sources.image_files import (
    NamedPair,
    PairSequence,
    Sizes,
    listed,
    open_pairs,
    progress,
)
from needle_tracker.tracker_parameters import StereoTrackerParameters

DESCRIPTION = """\
Measure the needle's tip in stereo images or in two videos.

Images are paired by file name and processed in the order of their names (numbers sort as numbers).
The names of a pair are equal, or differ in left and right, l and r, or cam0 and cam1: left-0001.png
and right-0001.png are pair 0001. Frames of a video are named 000000, 000001, ...
"""
EPILOG = """\
The output is a CSV file with a line per pair:
  name            file name without left or right (video: number of the frame)
  valid           1 with a tip, 0 without; the tip's fields are then empty
  x_m y_m z_m     tip in rig: x up, z along the insertion, origin at the needle's entry point
  sigma_*_m       standard deviations of the tip
  pitch_rad yaw_rad   of the shaft at its visible end: asin(d_x) and atan2(-d_y, d_z)
  left_end right_end  expected number of needle ends at the tip, about 1 for a visible end
  left_shaft right_shaft  mean probability of shaft behind it; empty if nothing was found
  missing         why there is no tip; docs/own_rig.md gives remedies

With --insertion a single pair is enough for a tip. The stage's zero and scale may be wrong
(stage_zero_sigma, stage_scale_sigma): both are estimated and printed. Below an insertion of 8 mm
(entry_zone) the needle does not have to be visible.
Without --insertion an end that both views show clearly is the needle's, another one only after it
has moved like a needle.
--params has the parameters of the node stereo_tracker; those for topics have no effect.

examples:
  ros2 run needle_tracker track_images --calibration rig.yaml --left left --right right \\
      --insertion insertion.csv --output tips.csv
  ros2 run needle_tracker track_images --calibration out/calibration.yaml --left out/left \\
      --right out/right --insertion out/insertion.csv --output tips.csv \\
      --truth out/truth.csv --overlay out/seen
      errors of the tips, and annotated images, for a folder `out` of render_images

Figures in --json that require --truth, else null:
  compared missed tips_without_needle without_truth   numbers of pairs
  error_rms_mm error_p95_mm error_max_mm              in 3D; error_x_rms_mm, ... per axis
  error_sigmas      root mean square of error / standard deviation; ideally 1
  inside_95         share of the tips inside their 95 % ellipsoids

exit codes: 0 done; 2 invalid input or a missing file; 130 interrupted
"""
COLUMNS = (
    *("name", "valid", "x_m", "y_m", "z_m"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "pitch_rad", "yaw_rad"),
    *("left_end", "left_shaft", "right_end", "right_shaft", "missing"),
)
_NODE = "stereo_tracker"
_NEW_RUN = 10e-3  # change of the insertion between two images that begins a new run [m]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `track_images`; returns its exit code."""
    return run_command(lambda: _run(_parser().parse_args(arguments)))


def _run(given: argparse.Namespace) -> int:
    output = output_file("--output", given.output)
    json = output_file("--json", given.json)
    parameters = _parameters(given)
    calibration = load_calibration(Path(given.calibration))
    insertions = read_insertions(Path(given.insertion)) if given.insertion else {}
    pairs = open_pairs(Path(given.left), Path(given.right))
    true = read_lengths(Path(given.truth), ("x_m", "y_m", "z_m")) if given.truth else {}
    truth = TruthComparison(true)
    overlays = None if given.overlay is None else Path(given.overlay).expanduser()
    if overlays is not None:
        make_folder(overlays)
    tracker = NeedleTracker(calibration, parameters, parameters.reference(calibration.sizes))
    tracker.warm_up()
    begin = time.perf_counter()
    rows: list[list[str]] = []
    unusable: list[str] = []
    without, stage, detected = 0, (0.0, 0.0), DetectionCounts()
    swap = SwapWatch(calibration, parameters)
    for pair, insertion, measured in track(pairs, tracker, calibration.sizes, insertions):
        without += insertion is None
        if problem := pair.problem(calibration.sizes):
            unusable.append(f"{pair.name} ({problem})")
        if pair.left is not None and pair.right is not None:
            if not problem:
                swap.update(pair.left, pair.right, insertion, measured)
            if overlays is not None:
                picture = annotate(pair.left, pair.right, measured)[..., ::-1]
                cv2.imwrite(str(overlays / f"{Path(pair.name).stem}.jpg"), picture)
        truth.add(pair.names, measured)
        detected.add(measured)
        rows.append(to_row(pair.name, measured))
        stage = measured.stage if measured.tip is not None else stage
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
    write_text(output, text.getvalue())
    found = sum(row[1] == "1" for row in rows)
    print(f"{found} tips in {len(rows)} pairs: {output}\n{detected.describe()}")
    if given.insertion:
        print(f"  stage: zero off by {1e3 * stage[0]:.2f} mm, scale by {100.0 * stage[1]:.2f} %")
    if given.truth:
        print(truth.describe())
    if overlays is not None:
        print(f"drawn: {overlays}")
    warnings = {
        f"{SUSPICION}; exchange --left and --right": swap.suspected,
        pairs.missing: pairs.missing,
        f"{len(unusable)} pairs cannot be used: {listed(unusable)}": unusable,
        f"{without} pairs have no insertion": given.insertion and without,
    }
    for warning, holds in warnings.items():
        if holds:
            _warn(warning)
    result: dict[str, JsonValue] = {
        "pairs": len(rows),
        "tips": found,
        "unpaired": len(pairs.unpaired),
        "unreadable": len(unusable),
        "without_insertion": without,
        **detected.figures(),
        "wall_s": time.perf_counter() - begin,
        **(truth.figures() if given.truth else dict.fromkeys(truth.figures())),
    }
    write_json(json, result)
    return EXIT_DONE


def _parameters(given: argparse.Namespace) -> StereoTrackerParameters:
    """Return the parameters of the node: defaults, and those of --params."""
    if given.params is None:
        return StereoTrackerParameters()
    sections = read_sections(Path(given.params))
    values = values_for(given.params, sections, f"/{_NODE}", _NODE)
    if values is None:
        _warn(missing_section_warning(given.params, sections, f"/{_NODE}"))
    return from_values(StereoTrackerParameters, values or {}, _NODE)


def track(
    pairs: PairSequence, tracker: NeedleTracker, sizes: Sizes, insertions: Mapping[str, float]
) -> Iterator[tuple[NamedPair, float | None, Measurement]]:
    """Run the tracker on a sequence of pairs; yield each with its insertion and its result.

    Parameters
    ----------
    pairs : PairSequence
        The images.
    tracker : NeedleTracker
        Tracker without history.
    sizes : dict of str to (int, int)
        Width and height of the images of the calibration [px].
    insertions : mapping
        Insertion [m] by any name of a pair.

    Raises
    ------
    UserError
        The size of the first readable images differs from the calibration.
    """
    last, checked = None, False
    for pair in progress(pairs, "tracking"):
        insertion = pair.number_in(insertions)
        if insertion is not None:
            if last is not None and abs(insertion - last) > _NEW_RUN:
                tracker.reset()
            last = insertion
        problem = pair.problem(sizes)
        if pair.left is None or pair.right is None or (problem and checked):
            yield pair, insertion, tracker.skip(problem)
            continue
        if problem:
            raise UserError(f"{pair.name}: {problem}")
        checked = True
        yield pair, insertion, tracker.process(pair.left, pair.right, insertion)


def to_row(name: str, measured: Measurement) -> list[str]:
    """Return the CSV line of a pair; a tip from the insertion alone does not count."""
    tip, cause = measured.tip, missing(measured)
    measured_fields = [""] * 8
    if tip is not None and not cause:
        d_x, d_y, d_z = tip.direction.tolist()
        angles = math.asin(min(max(d_x, -1.0), 1.0)), math.atan2(-d_y, d_z)
        values = (*tip.position, *np.sqrt(np.diag(tip.covariance)), *angles)
        measured_fields = [f"{value:.9f}" for value in values]
    shown: list[str] = []
    for end in measured.ends:
        shown += ["", ""] if end is None else [f"{end.ends:.2f}", f"{end.shaft:.2f}"]
    return [name, "0" if cause else "1", *measured_fields, *shown, cause]


def _warn(what: str) -> None:
    print(f"warning: {what}", file=sys.stderr)


def _parser() -> CommandParser:
    parser = CommandParser("track_images", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add("--calibration", required=True, metavar="FILE", help="calibration file of the stereo rig")
    add("--left", required=True, metavar="DIR", help="folder of the left images, or a video")
    add("--right", required=True, metavar="DIR", help="folder of the right images, or a video")
    add("--insertion", metavar="FILE", help="CSV name,insertion_m")
    add("--output", required=True, metavar="FILE.csv", help="file for the tips")
    add(
        "--overlay",
        metavar="DIR",
        help="new folder for an annotated image of each pair: the shaft's end in green (yellow: "
        "only its line, red: rejected), with the confidence of end and shaft in each view",
    )
    add(
        "--truth",
        metavar="FILE",
        help="CSV name,x_m,y_m,z_m of the true tips, empty without a needle (written by "
        "render_images): print the errors in mm and in standard deviations",
    )
    add("--params", metavar="FILE", help="ROS parameter file with stereo_tracker's parameters")
    add("--json", metavar="FILE", help="also write the figures as flat JSON")
    return parser


if __name__ == "__main__":
    sys.exit(main())
