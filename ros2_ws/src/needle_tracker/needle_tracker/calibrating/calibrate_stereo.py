"""`ros2 run needle_tracker calibrate_stereo`: images of a ChArUco board to a calibration file."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_tracker.calibrating.board_views import nothing_seen, views_in_folders
from needle_tracker.calibrating.calibration_figures import residual_figure, rig_figure, save_figure
from needle_tracker.calibrating.calibration_outliers import doubts, misfits, square_error
from needle_tracker.calibrating.calibration_session import load_session
from needle_tracker.calibrating.charuco import CharucoBoard, write_board
from needle_tracker.calibrating.imported_lenses import read_lenses
from needle_tracker.calibrating.pair_consistency import PairsApartError, apart_in_words
from needle_tracker.calibrating.rig_calibration import RigCalibration, calibrate
from needle_tracker.calibrating.rig_model import SURFACE, BoardView
from needle_tracker.optics.calibration import SIDES, StereoCalibration
from needle_tracker.optics.window import Window

_DESCRIPTION = """\
Calibrate the stereo rig from images of a ChArUco board.

LEFT and RIGHT hold the images of each camera. Paired are equal names, and names that differ in
left and right, l and r, or cam0 and cam1 (then LEFT and RIGHT may be one folder). The session file
says what the board is and where it lay, in metres in the frame `rig` (x up, z along the insertion,
origin at the needle's entry point):

  board: {columns: 12, rows: 9, square: 0.010, marker: 0.0075, dictionary: DICT_5X5_100}
  phantom: {surface_height: 0.0175, refractive_index: 1.33}      # kept where not determined
  places:                                                        # by file name, * and ? allowed
    surface_near: {origin: [0.0185, -0.045, 0.0025]}
    surface_far: {origin: [0.0185, -0.045, 0.0125]}
    under_wedge: {origin: [-0.0125, -0.045, 0.004], columns: [0.2079, 0, 0.9781],
                  under_surface: true, sigma: 2.0e-5}

`origin` is the outer corner of the pattern's first square, top left as printed; `columns` and
`rows` are the directions in which these count (default [0, 0, 1] and [0, 1, 0]); `sigma` is how
well the place is known. An image whose name has no place is a board held freely in air: 6 at
least, 20 are better, tilted by 15 to 45 deg in all directions. docs/calibration.md says how to take
the images, and how to calibrate cameras that look through walls or from aside.

--lenses keeps lenses and relative pose as ROS (LEFT.yaml RIGHT.yaml), Kalibr (camchain.yaml; cam0
is left) or OpenCV (intrinsics.yml extrinsics.yml) wrote them, in metres: then a board at one place
in air, and those under the surface, suffice.
"""
_SCALE_TOLD = 0.1  # [%]
_EPILOG = """\
writes: FILE.yaml, FILE.rig.png (cameras, surface, boards), FILE.residuals.png

examples:
  ros2 run needle_tracker calibrate_stereo --board board.pdf
  ros2 run needle_tracker calibrate_stereo --left L --right R --session S.yaml --output rig.yaml

exit codes: 0 done; 1 calibrated and written, but NOT OK, or tips are not expected within --goal-mm;
1, and nothing written, where many pairs were not taken at once; 2 bad input or a set of views that
cannot determine the rig (nothing written); 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(lambda: calibrate_stereo(sys.argv[1:] if arguments is None else arguments))


def calibrate_stereo(arguments: Sequence[str]) -> int:
    """Calibrate as the command line says, print and write the result."""
    options = _parser().parse_args(arguments)
    if options.board is not None:
        board = CharucoBoard() if options.session is None else load_session(options.session).board
        write_board(board, options.board)
        print(f"{options.board}: print at 100 %, then measure the squares")
        return EXIT_DONE
    for name in ("left", "right", "session", "output"):
        if getattr(options, name) is None:
            raise UserError(f"--{name} is missing; see --help")
    if not (math.isfinite(options.goal_mm) and options.goal_mm > 0.0):
        raise UserError(f"--goal-mm {options.goal_mm} is not above 0")
    if not options.output.parent.is_dir():
        raise UserError(f"--output {options.output}: {options.output.parent} is not a folder")
    session = load_session(options.session)
    views, sizes = views_in_folders(options.left, options.right, session)
    empty = [view.name for view in views if nothing_seen(view) and view.place is None]
    if empty:
        print(f"left out, no board found: {', '.join(empty)}")
    views = [view for view in views if view.name not in empty]
    lenses = options.lenses and read_lenses(options.lenses, sizes, session.windows)
    try:
        result = calibrate(views, sizes, session.windows, lenses)
    except PairsApartError as error:
        print(f"NOT OK: {error}; nothing is written")
        if options.json is not None:
            write_json(options.json, {"problem": str(error)})
        return EXIT_MISSED
    size = square_error(result)
    problems = doubts(result, size)
    said = [report(result, size, options.goal_mm), *(f"NOT OK: {one}" for one in problems)]
    text = "\n".join(said)
    print(text)
    save_calibration(options.output, result.calibration, text.splitlines())
    save_figure(rig_figure(result), options.output.with_suffix(".rig.png"))
    save_figure(residual_figure(result), options.output.with_suffix(".residuals.png"))
    if options.json is not None:
        values = figures(result, options.goal_mm) | {"problem": "; ".join(problems) or None}
        write_json(options.json, values)
    print(f"written: {options.output}")
    good = not problems and 1e3 * result.tip_error_p95 <= options.goal_mm
    return EXIT_DONE if good else EXIT_MISSED


def view_set(view: BoardView) -> str:
    """Return which set a view is of: free, surface (known place in air) or under."""
    if view.place is None:
        return "free"
    return "under" if view.under_surface else "surface"


def reprojection_by_set(result: RigCalibration) -> dict[tuple[str, str], float]:
    """Return the reprojection error by camera and set of views, rms [px]; only sets there are."""
    errors = {}
    sets = [view_set(view) for view in result.model.views]
    for side in SIDES:
        of_corner = np.array(sets)[result.model.view_of[side]]
        for name in ("free", "surface", "under"):
            chosen = result.residuals(side)[of_corner == name]
            if len(chosen):
                errors[side, name] = float(np.sqrt(np.mean(np.sum(chosen**2, axis=-1))))
    return errors


def report(result: RigCalibration, size: tuple[float, float], goal_mm: float) -> str:
    """Return a calibration as a person reads it."""
    sets = [view_set(view) for view in result.model.views]
    counts = ", ".join(f"{sets.count(name)} {name}" for name in ("free", "surface", "under"))
    lines = [
        f"views: {counts}; corners: {len(result.model.pixels['left'])} left, "
        f"{len(result.model.pixels['right'])} right, each to {result.fit.corner_sigma_px:.3f} px"
    ]
    lines += [
        f"reprojection error, {side} camera, {name} boards: {error:.3f} px rms"
        for (side, name), error in reprojection_by_set(result).items()
    ]
    if result.apart:
        lines.append(f"WARNING: {apart_in_words(result.apart)}; left out")
    lines += [f"WARNING: {text}" for view, text in misfits(result) if view.place is None]
    if "left.fx" not in result.parameters:
        pose = " and relative pose" if result.model.tied else ""
        lines.append(f"lenses{pose}: as given; an error of theirs adds to that of tips below")
    for name, found in result.parameters.items():
        scale, unit = _unit(name)
        value, given, sigma = (scale * v for v in (found.value, found.given, found.sigma))
        if not found.kept:
            lines.append(f"{name}: {value:.5g}{unit} +- {sigma:.2g}{unit}")
        elif math.isfinite(sigma):
            lines.append(
                f"{name}: NOT DETERMINED by these views (+- {sigma:.2g}{unit}), kept at the given "
                f"{given:g}{unit}"
            )
        else:
            lines.append(f"{name}: not asked of these views, kept at the given {given:g}{unit}")
    error, sigma = (100.0 * value for value in size)
    if sigma < _SCALE_TOLD:
        lines.append(f"size of the squares: {error:+.2f} +- {sigma:.2f} % beside the session's")
    else:
        lines.append(
            "size of the squares: not told by these views (a board laid on the surface twice, "
            "10 mm or more apart, tells it); tips are wrong by as much as it is"
        )
    error_mm = 1e3 * result.tip_error_p95
    verdict = "within" if error_mm <= goal_mm else "NOT within"
    lines.append(
        f"expected error of a tip in the phantom from what was determined, 95 %: {error_mm:.3f} mm "
        f"({verdict} {goal_mm:g} mm)"
    )
    if any(result.parameters[name].kept for name in SURFACE if name in result.parameters):
        lines.append(
            "an error of a given value comes on top: about 0.14 mm for 0.01 of the index, 0.31 mm "
            "for 1 mm of the surface"
        )
    return "\n".join(lines)


def figures(result: RigCalibration, goal_mm: float) -> dict[str, JsonValue]:
    """Return a calibration's figures, flat, for --json."""
    values: dict[str, JsonValue] = {
        "views": len(result.model.views),
        "corner_sigma_px": result.fit.corner_sigma_px,
        "tip_error_p95_mm": 1e3 * result.tip_error_p95,
        "goal_mm": goal_mm,
    }
    for (side, name), error in reprojection_by_set(result).items():
        values[f"reprojection_{side}_{name}_px"] = error
    for name, found in result.parameters.items():
        key = name.replace(".", "_")
        scale, unit = _unit(name)
        if unit:
            key += f"_{unit.strip()}"
        elif name.split(".")[-1] in ("fx", "fy", "cx", "cy"):
            key += "_px"
        values[key] = scale * found.value
        values[f"sigma_{key}"] = scale * found.sigma
        values[f"determined_{name.replace('.', '_')}"] = not found.kept
    return values


def _unit(name: str) -> tuple[float, str]:
    """Return the factor to a person's unit of a parameter, and that unit in words."""
    if "tilt" in name:
        return math.degrees(1.0), " deg"
    return (1e3, " mm") if name.endswith(("surface_height", "window_offset")) else (1.0, "")


def _parser() -> CommandParser:
    parser = CommandParser("calibrate_stereo", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add("--left", type=Path, metavar="DIR", help="images of the left camera")
    add("--right", type=Path, metavar="DIR", help="images of the right camera")
    add("--session", type=Path, metavar="FILE", help="board, windows and places (YAML)")
    add("--output", type=Path, metavar="FILE.yaml", help="the calibration file to write")
    add("--lenses", type=Path, nargs="+", metavar="FILE", help="keep these lenses (see above)")
    add("--goal-mm", type=float, default=0.06, metavar="MM", help="wanted tip error (0.06)")
    add("--json", type=Path, metavar="FILE", help="also write the figures as flat JSON")
    add("--board", type=Path, metavar="FILE.pdf|.png", help="write a board to print and end")
    return parser


def calibration_text(calibration: StereoCalibration, comments: list[str]) -> str:
    """Return the YAML text of a calibration.

    Parameters
    ----------
    calibration : StereoCalibration
        What to write.
    comments : list of str
        Lines to put before it.
    """
    surface = calibration.surface
    lines = [f"# {line}" for line in comments]
    if surface is not None:
        lines.append(
            f"phantom: {{surface_height: {surface.point[0]:.9f}, "
            f"refractive_index: {surface.inside:.6f}}}"
        )
    for side, camera in zip(SIDES, (calibration.left, calibration.right), strict=True):
        matrix = ", ".join(f"{value:.4f}" for value in camera.camera_matrix.ravel())
        lens = ", ".join(f"{value:.9f}" for value in camera.distortion)
        translation = ", ".join(f"{value:.9f}" for value in camera.T_optical_rig[:3, 3])
        quaternion = Rotation.from_matrix(camera.T_optical_rig[:3, :3]).as_quat()
        rotation = ", ".join(f"{value:.12f}" for value in quaternion)
        lines += [
            f"{side}:",
            f"  image_width: {camera.width}",
            f"  image_height: {camera.height}",
            f"  camera_matrix: {{rows: 3, cols: 3, data: [{matrix}]}}",
            "  distortion_model: plumb_bob",
            f"  distortion_coefficients: {{rows: 1, cols: 5, data: [{lens}]}}",
            "  T_optical_rig:",
            f"    translation: [{translation}]",
            f"    rotation: [{rotation}]",
        ]
        if surface is None:
            lines += _window_lines(camera.window)
    return "\n".join(lines) + "\n"


def _window_lines(window: Window) -> list[str]:
    point = ", ".join(f"{value:.9f}" for value in window.point)
    normal = ", ".join(f"{value:.12f}" for value in window.normal)
    layers = ", ".join(
        f"{{thickness: {layer.thickness:.9f}, refractive_index: {layer.refractive_index:.6f}}}"
        for layer in window.layers
    )
    return [
        "  window:",
        f"    point: [{point}]",
        f"    normal: [{normal}]",
        f"    layers: [{layers}]",
        f"    inside: {window.inside:.6f}",
    ]


def save_calibration(path: Path, calibration: StereoCalibration, comments: list[str]) -> None:
    """Write a calibration file.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    try:
        path.write_text(calibration_text(calibration, comments), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error


if __name__ == "__main__":
    sys.exit(main())
