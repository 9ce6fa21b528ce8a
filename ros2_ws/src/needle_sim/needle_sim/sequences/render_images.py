"""`ros2 run needle_sim render_images`: image sequences without a ROS graph."""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from needle_core.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser, number, output_file, whole_number
from needle_core.errors import UserError
from needle_core.files.installed import find_shared_file
from needle_sim.camera.image_folder import ImageFolder, RenderedPair
from needle_sim.camera.insertions import CURVATURE, render_insertion
from needle_sim.camera.scenarios import CLEAN, SCENARIOS, Scenario, find_scenario
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.path_traced.appearance import APPEARANCES, RANDOM, Appearance, draw_appearance
from needle_sim.path_traced.insertion import TRUTH_COLUMNS, trace_insertion
from needle_sim.path_traced.tracer import load_mitsuba
from needle_sim.sequences.boxes import draw_box

RENDERERS = ("quick", "path_traced")

DESCRIPTION = """\
Render stereo images of a needle during its insertion into a phantom, on a random steered path.

Writes left/NNNNNN.png, right/NNNNNN.png, calibration.yaml, insertion.csv (name, insertion_m) and
truth.csv: the tip, pitch and yaw of the heading and of the visible end of the shaft, and the share
of the last 10 mm that each camera sees; fields are empty without a needle. The first frame is at
insertion 0 or --start-mm; the stage stops at the depth.

Renderer quick draws a line as wide as the needle, with the disturbances of a scenario. Renderer
path_traced traces the light in a scene of metal, lamps and floor, given by an appearance; truth.csv
then also contains the bevel. It requires an optional extra (docs/dependencies.md).
"""

EPILOG = """\
examples:
  ros2 run needle_sim render_images --output /tmp/clutter --scenario clutter
  ros2 run needle_sim render_images --output /tmp/traced --renderer path_traced --seed 7 \\
      --start-mm 54 --depth-mm 60
  ros2 run needle_sim render_images --output /tmp/box --renderer path_traced --box --seed 7 \\
      --appearance drawn_before_clutter --start-mm 54 --depth-mm 60

exit codes: 0 done; 2 invalid input or a missing file or package; 130 interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `render_images`; return its exit code."""
    argv = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: render_images(_parser().parse_args(argv)))


def render_images(given: argparse.Namespace) -> int:
    """Render the images that the options describe; return the exit code.

    Raises
    ------
    UserError
        If an option is invalid.
    """
    depth = number("--depth-mm", given.depth_mm, 1.0, 300.0, "mm") / 1e3
    step = number("--step-mm", given.step_mm, 0.001, 50.0, "mm") / 1e3
    begin = number("--start-mm", given.start_mm, 0.0, depth * 1e3, "mm") / 1e3
    frames = math.ceil((depth - begin) / step - 1e-9) + 1
    if given.frames is not None:
        frames = whole_number("--frames", given.frames, 1, 999_999)
    seed = whole_number("--seed", given.seed, 0, 2**31 - 1)
    look = _look(given, seed)
    curvature = number("--curvature", given.curvature, 0.0, 100.0, "1/m")
    path = {"depth": depth, "step": step, "begin": begin, "curvature": curvature, "frames": frames}
    output, summary = Path(given.output).expanduser(), output_file("--json", given.json)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        calibration = _calibration(given, seed, Path(folder))
        written = _write(look, seed, path, output, calibration)
        is_silent = not sys.stderr.isatty()
        for _ in tqdm(
            written, total=frames, unit="pair", delay=1.0, leave=False, disable=is_silent
        ):
            pass
    wall = time.perf_counter() - started
    print(f"{frames} pairs of {look.name} in {output}, {wall:.1f} s")
    if summary is not None:
        kind = "scenario" if isinstance(look, Scenario) else "appearance"
        result: dict[str, JsonValue] = {
            "renderer": given.renderer,
            kind: look.name,
            "frames": frames,
            "seed": seed,
            "output": str(output),
            "wall_s": wall,
        }
        write_json(summary, result)
    return EXIT_DONE


def _look(given: argparse.Namespace, seed: int) -> Scenario | Appearance:
    """Return the scenario or appearance; reject options of the other renderer."""
    if given.renderer not in RENDERERS:
        raise UserError(f"--renderer {given.renderer!r} is not one of {', '.join(RENDERERS)}")
    if given.renderer == "path_traced":
        for name, text in (("--scenario", given.scenario), ("--noise", given.noise)):
            if text is not None:
                raise UserError(f"{name} is for renderer quick; path_traced takes --appearance")
        return draw_appearance(given.appearance or RANDOM, seed)
    if given.appearance is not None:
        raise UserError("--appearance is for renderer path_traced; quick takes --scenario")
    look = find_scenario(given.scenario or CLEAN.name)
    if given.noise is not None:
        noise = number("--noise", given.noise, 0.0, 50.0, "grey levels")
        return dataclasses.replace(look, noise=noise)
    return look


def _calibration(given: argparse.Namespace, seed: int, folder: Path) -> Path:
    """Return the calibration file: given, shipped, or of a box, which is written into `folder`."""
    if given.box:
        if given.calibration is not None:
            raise UserError("--box generates its own calibration: omit --calibration")
        box = folder / "box.yaml"
        box.write_text(draw_box(seed), encoding="utf-8")
        return box
    if given.calibration is not None:
        return Path(given.calibration).expanduser()
    return find_shared_file("needle_tracker", "config/calibration.yaml")


def _write(
    look: Scenario | Appearance, seed: int, path: Mapping[str, Any], output: Path, calibration: Path
) -> Iterator[None]:
    """Write the pairs, one per iteration."""
    rig = load_stereo_rig(calibration)
    columns: tuple[str, ...] = ()
    pairs: Iterator[RenderedPair]
    if isinstance(look, Scenario):
        pairs = render_insertion(rig, look, seed=seed, **path)
    else:
        columns, pairs = TRUTH_COLUMNS, trace_insertion(load_mitsuba(), rig, look, **path)
    folder = ImageFolder(output, calibration, columns)
    for pair in pairs:
        folder.write(pair)
        yield


def _parser() -> CommandParser:
    parser = CommandParser(
        "render_images",
        DESCRIPTION,
        "scenarios (renderer quick):\n"
        + "".join(f"  {name:22}{one.summary}\n" for name, one in SCENARIOS.items())
        + "\nappearances (renderer path_traced):\n"
        + "".join(f"  {name:22}{one.summary}\n" for name, one in APPEARANCES.items())
        + "\n"
        + EPILOG,
    )
    add = parser.add_argument
    add("--output", required=True, metavar="DIR", help="new or empty folder")
    add("--renderer", default="quick", metavar="R", help="quick or path_traced (default: quick)")
    add("--scenario", metavar="NAME", help="for quick, see below (default: clean)")
    add("--appearance", metavar="NAME", help="for path_traced, see below (default: random)")
    add("--frames", metavar="N", help="number of pairs (default: up to the depth)")
    add("--seed", default="0", metavar="N", help="seed of path and images (default: 0)")
    add("--start-mm", default="0", metavar="D", help="insertion at the first frame (default: 0)")
    add("--depth-mm", default="120", metavar="D", help="final insertion [mm] (default: 120)")
    add("--step-mm", default="1", metavar="S", help="insertion between frames [mm] (default: 1)")
    add(
        "--curvature",
        default=repr(CURVATURE),
        metavar="K",
        help=f"curvature of the needle's path [1/m] (default: {CURVATURE:.3f})",
    )
    add("--noise", metavar="SIGMA", help="noise of quick [grey levels] (default: the scenario's)")
    add("--calibration", metavar="FILE", help="of the cameras (default: needle_tracker's)")
    add("--box", action="store_true", help="two webcams and an acrylic box, drawn from the seed")
    add("--json", metavar="FILE", help="also write a summary as flat JSON")
    return parser


if __name__ == "__main__":
    sys.exit(main())
