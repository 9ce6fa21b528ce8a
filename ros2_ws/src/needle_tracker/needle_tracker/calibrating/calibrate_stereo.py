"""`ros2 run needle_tracker calibrate_stereo`: calibration file from images of a ChArUco board."""

from __future__ import annotations

import dataclasses
import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser, output_file
from needle_core.errors import UserError
from needle_core.files.yaml_files import write_yaml
from needle_core.settings.bounds import ABOVE_0, check_bounds
from needle_tracker.calibrating.calibration_outliers import contradictions, misfits
from needle_tracker.calibrating.calibration_session import (
    KINDS,
    load_session,
    no_board_detected,
    views_in_folders,
)
from needle_tracker.calibrating.calibration_start import PairsApartError, describe_apart
from needle_tracker.calibrating.charuco import CharucoBoard, save_figure, write_board
from needle_tracker.calibrating.imported_lenses import read_lenses
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.calibrating.rig_fit import rms_px
from needle_tracker.calibrating.rig_model import LENS, SURFACE, unit_of
from needle_tracker.optics.calibration import SIDES, StereoCalibration, Window

Array = NDArray[np.float64]

_DESCRIPTION = """\
Calibrate the stereo rig from images of a ChArUco board.

The folders --left and --right have the images of the cameras. The names of a pair are equal, or
differ in left and right, l and r, or cam0 and cam1 (both folders may then be the same). The session
file describes the board and its places, in metres in the frame `rig` (x up, z along the insertion,
origin at the needle's entry point):

  board: {columns: 12, rows: 9, square: 0.010, marker: 0.0075, dictionary: DICT_5X5_100}
  phantom: {surface_height: 0.0175, refractive_index: 1.33}      # used if not determined
  places:                                                        # by file name, * and ? allowed
    surface_near: {origin: [0.0185, -0.045, 0.0025]}
    surface_far: {origin: [0.0185, -0.045, 0.0125]}
    under_wedge: {origin: [-0.0125, -0.045, 0.004], columns: [0.2079, 0, 0.9781],
                  under_surface: true, sigma: 2.0e-5}

`origin` is the outer corner of the pattern's first square, top left as printed; `columns` and
`rows` are the directions of increasing columns and rows (default [0, 0, 1] and [0, 1, 0]); `sigma`
is the standard deviation of the place. Images without a place show the board held freely in air:
at least 6, better 20, tilted by 15 to 45 deg in all directions. docs/calibration.md explains how to
take the images, and how to calibrate cameras that look through walls or from the side.

--lenses keeps the lenses and the relative pose of a calibration by ROS (LEFT.yaml RIGHT.yaml),
Kalibr (camchain.yaml; cam0 is left) or OpenCV (intrinsics.yml extrinsics.yml), in metres: one place
in air and the places under the surface are then enough.
"""
_COLOURS = {"left": "#1668b0", "right": "#d1701b"}
_BOARDS = {
    "free": ("board held freely", "#9aa0a8"),
    "surface": ("board of known place in air", "#1b1b1b"),
    "under": ("board under the surface", "#b03060"),
}
_MM = 1e3
_SCALE_KNOWN = 0.1  # largest standard deviation of a determined size of the squares [%]
_EPILOG = """\
writes: FILE.yaml, FILE.rig.png (cameras, surface, boards)

examples:
  ros2 run needle_tracker calibrate_stereo --board board.pdf
  ros2 run needle_tracker calibrate_stereo --left L --right R --session S.yaml --output rig.yaml

exit codes: 0 done; 1 NOT OK or a tip error above --goal-mm (the calibration is written), or many
pairs not taken simultaneously (nothing is written); 2 invalid input, or the views do not determine
the rig (nothing is written); 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(lambda: _run(_parser().parse_args(arguments)))


def _run(options: Namespace) -> int:
    """Calibrate, print and write the result."""
    if options.board is not None:
        board = CharucoBoard() if options.session is None else load_session(options.session).board
        write_board(board, options.board)
        print(f"{options.board}: print at 100 %, then measure the squares")
        return EXIT_DONE
    for name in ("left", "right", "session", "output"):
        if getattr(options, name) is None:
            raise UserError(f"--{name} is missing; see --help")
    check_bounds("--goal-mm", options.goal_mm, ABOVE_0, 100.0, "mm")
    options.output = output_file("--output", options.output)
    session = load_session(options.session)
    views, sizes = views_in_folders(options.left, options.right, session)
    empty = [view.name for view in views if no_board_detected(view) and view.kind == "free"]
    if empty:
        print(f"left out, no board found: {', '.join(empty)}")
    views = [view for view in views if view.name not in empty]
    lenses = options.lenses and read_lenses(options.lenses, sizes, session.windows)
    try:
        result = calibrate(views, sizes, session.windows, lenses)
    except PairsApartError as error:
        print(f"NOT OK: {error}; nothing is written")
        write_json(options.json, {"problem": str(error)})
        return EXIT_MISSED
    problems = contradictions(result)
    lines = [*report(result, options.goal_mm), *(f"NOT OK: {one}" for one in problems)]
    print("\n".join(lines))
    save_calibration(options.output, result.calibration, lines)
    save_figure(rig_figure(result), options.output.with_suffix(".rig.png"), 130)
    values = figures(result, options.goal_mm) | {"problem": "; ".join(problems) or None}
    write_json(options.json, values)
    print(f"written: {options.output}")
    good = not problems and 1e3 * result.tip_error_p95 <= options.goal_mm
    return EXIT_DONE if good else EXIT_MISSED


def reprojection_by_kind(result: RigCalibration) -> dict[tuple[str, str], float]:
    """Return the rms reprojection error by camera and kind of view, omitting absent kinds [px]."""
    kind_of = np.array([view.kind for view in result.model.views])[result.model.view_of]
    return {
        (side, kind): rms_px(result.fit.residuals[chosen])
        for side in SIDES
        for kind in KINDS
        if np.any(chosen := result.model.seen_by[side] & (kind_of == kind))
    }


def report(result: RigCalibration, goal_mm: float) -> list[str]:
    """Return a calibration as lines of text."""
    kinds = [view.kind for view in result.model.views]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in KINDS)
    left, right = (np.count_nonzero(result.model.seen_by[side]) for side in SIDES)
    lines = [
        f"views: {counts}; corners: {left} left, {right} right, "
        f"each to {result.fit.corner_sigma_px:.3f} px"
    ]
    for (side, kind), error in reprojection_by_kind(result).items():
        lines.append(f"reprojection error, {side} camera, {kind} boards: {error:.3f} px rms")
    if result.apart:
        lines.append(f"WARNING: {describe_apart(result.apart)}; left out")
    lines += [f"WARNING: {text}" for view, text in misfits(result) if view.kind == "free"]
    if "left.fx" not in result.parameters:
        lines.append("lenses: as given; their error adds to the tip error below")
    for name, found in result.parameters.items():
        scale, unit = unit_of(name)
        value, sigma, unit = scale * found.value, scale * found.sigma, unit and f" {unit}"
        kept = f" (NOT DETERMINED by these views, kept as given: {value:g}{unit})"
        lines.append(f"{name}: {value:.5g}{unit} +- {sigma:.2g}{unit}{kept if found.kept else ''}")
    error, sigma = (100.0 * value for value in result.square_error)
    if sigma < _SCALE_KNOWN:
        lines.append(f"size of the squares: {error:+.2f} +- {sigma:.2f} % relative to the session")
    else:
        lines.append(
            "size of the squares: not determined by these views (a board on the surface twice, "
            "10 mm or more apart, determines it); tip errors scale with it"
        )
    error_mm = 1e3 * result.tip_error_p95
    verdict = "within" if error_mm <= goal_mm else "NOT within"
    lines.append(
        f"expected tip error in the phantom from the determined values, 95 %: {error_mm:.3f} mm "
        f"({verdict} {goal_mm:g} mm)"
    )
    if any(result.parameters[name].kept for name in SURFACE if name in result.parameters):
        lines.append(
            "errors of given values add to it: about 0.14 mm for 0.01 of the index, 0.31 mm "
            "for 1 mm of the surface"
        )
    return lines


def figures(result: RigCalibration, goal_mm: float) -> dict[str, JsonValue]:
    """Return the figures of a calibration for --json."""
    values: dict[str, JsonValue] = {
        "views": len(result.model.views),
        "corner_sigma_px": result.fit.corner_sigma_px,
        "tip_error_p95_mm": 1e3 * result.tip_error_p95,
        "goal_mm": goal_mm,
    }
    for (side, kind), error in reprojection_by_kind(result).items():
        values[f"reprojection_{side}_{kind}_px"] = error
    for name, found in result.parameters.items():
        key = name.replace(".", "_")
        scale, unit = unit_of(name)
        unit = "px" if name.split(".")[-1] in LENS[:4] else unit
        key += unit and f"_{unit}"
        values[key] = scale * found.value
        values[f"sigma_{key}"] = scale * found.sigma
        values[f"determined_{name.replace('.', '_')}"] = not found.kept
    return values


def _parser() -> CommandParser:
    parser = CommandParser("calibrate_stereo", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add("--left", type=Path, metavar="DIR", help="images of the left camera")
    add("--right", type=Path, metavar="DIR", help="images of the right camera")
    add("--session", type=Path, metavar="FILE", help="board, windows and places (YAML)")
    add("--output", type=Path, metavar="FILE.yaml", help="calibration file to write")
    add("--lenses", type=Path, nargs="+", metavar="FILE", help="keep these lenses (see above)")
    add("--goal-mm", type=float, default=0.06, metavar="MM", help="required tip error (0.06)")
    add("--json", type=Path, metavar="FILE", help="also write the figures as flat JSON")
    add("--board", type=Path, metavar="FILE.pdf|.png", help="write a board for printing, and exit")
    return parser


def save_calibration(path: Path, calibration: StereoCalibration, comments: list[str]) -> None:
    """Write a calibration file.

    Parameters
    ----------
    path : Path
        The file.
    calibration : StereoCalibration
        The calibration.
    comments : list of str
        Lines of the header.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    surface, content = calibration.surface, dict[str, Any]()
    if surface is not None:
        height, index = float(surface.point[0]), float(surface.inside)
        content["phantom"] = {"surface_height": height, "refractive_index": index}
    for side, camera in calibration.cameras.items():
        pose, window = camera.T_optical_rig, camera.window
        content[side] = {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_matrix": {"rows": 3, "cols": 3, "data": camera.camera_matrix.ravel().tolist()},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": camera.distortion.tolist()},
            "T_optical_rig": {
                "translation": pose[:3, 3].tolist(),
                "rotation": Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(),
            },
        }
        if surface is None:
            content[side]["window"] = {
                "point": window.point.tolist(),
                "normal": window.normal.tolist(),
                "layers": [dataclasses.asdict(layer) for layer in window.layers],
                "inside": float(window.inside),
            }
    write_yaml(path, content, comments)


def rig_figure(result: RigCalibration) -> Figure:
    """Return a figure of the rig from two sides: cameras, surface, boards."""
    figure = Figure(figsize=(9.0, 8.5), layout="constrained")
    planes = (2, "z (insertion) [mm]"), (1, "y [mm]")
    for axes, (axis, label) in zip(figure.subplots(1, 2), planes, strict=True):
        axes.plot(0, 0, "k+", markersize=12, label="rig (entry point)")
        for i, view in enumerate(result.model.views):
            outline, (name, colour) = _MM * _board_outline(result, i), _BOARDS[view.kind]
            axes.plot(outline[:, axis], outline[:, 0], color=colour, linewidth=1.5, label=name)
        for side, camera in result.calibration.cameras.items():
            centre, ahead = _MM * camera.centre, 50.0 * camera.T_optical_rig[2, :3]
            axes.plot(centre[axis], centre[0], "o", color=_COLOURS[side], label=f"{side} camera")
            axes.arrow(centre[axis], centre[0], ahead[axis], ahead[0], color=_COLOURS[side])
            _draw_face(axes, camera.window, axis)
        axes.set(aspect="equal", xlabel=label, ylabel="x (up) [mm]")
        axes.grid(color="#e4e6ea")
    # The legend has each label once; matplotlib starts missing labels with _.
    named = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    shown = [line for name, line in named.items() if not str(name).startswith("_")]
    figure.legend(handles=shown, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle("The rig as calibrated")
    return figure


def _board_outline(result: RigCalibration, view: int) -> Array:
    points = np.concatenate([result.model.views[view].corners(side).points for side in SIDES])
    low, high = points.min(axis=0), points.max(axis=0)
    ring = np.array([low, [high[0], low[1], 0], high, [low[0], high[1], 0], low])
    pose = result.model.board_poses(result.fit.parameters)[view]
    return np.asarray(ring @ pose[:3, :3].T + pose[:3, 3])


def _draw_face(axes: Any, window: Window, axis: int) -> None:
    """Draw the outer face of a window if the plot shows it edge-on."""
    along, up = window.normal[axis], window.normal[0]
    if np.hypot(along, up) > 0.5:
        place = (_MM * window.point[axis], _MM * window.point[0])
        axes.axline(place, (place[0] + up, place[1] - along), color="#2e9d55", label="window")


if __name__ == "__main__":
    sys.exit(main())
