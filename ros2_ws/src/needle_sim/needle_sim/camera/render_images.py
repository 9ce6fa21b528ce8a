"""`ros2 run needle_sim render_images`: image sequences of a scenario, without any graph."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from tqdm import tqdm

from needle_common.commands.cli import EXIT_DONE, JsonValue, run_command, write_json
from needle_common.commands.options import CommandParser, number, output_file, whole_number
from needle_sim.camera.image_folder import ImageFolder
from needle_sim.camera.insertions import CURVATURE, render_insertion
from needle_sim.camera.scenarios import SCENARIOS, Scenario, find_scenario
from needle_sim.camera.stereo_rig import load_stereo_rig

DESCRIPTION = """\
Render the stereo images of a needle that goes into a phantom on a random, steered-like path.

The folder gets left/NNNNNN.png, right/NNNNNN.png, calibration.yaml, insertion.csv (name,
insertion_m) and truth.csv: the tip, pitch and yaw of heading and of the visible shaft's end, and
the share of the last 10 mm that each camera sees. Fields are empty where there is no needle. The
first frame is at insertion 0; where the depth is reached, the stage rests.
"""

EPILOG = """\
examples:
  ros2 run needle_sim render_images --output /tmp/clutter --scenario clutter
  ros2 run needle_sim render_images --output /tmp/empty --scenario absent --frames 720 --step-mm 0.2

exit codes: 0 done, 2 bad input or something missing, 130 interrupted.
"""


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """Options of `render_images`; SI."""

    output: Path
    scenario: Scenario
    frames: int
    seed: int
    depth: float
    step: float
    curvature: float
    calibration: Path | None
    json: Path | None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `render_images`; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: render_images(parse(words)))


def render_images(options: RenderOptions) -> int:
    """Render what was asked for."""
    begin = time.perf_counter()
    calibration = options.calibration
    if calibration is None:
        shared = Path(get_package_share_directory("needle_tracker"))
        calibration = shared / "config" / "calibration.yaml"
    rig = load_stereo_rig(calibration)
    pairs = render_insertion(
        rig,
        options.scenario,
        seed=options.seed,
        frames=options.frames,
        depth=options.depth,
        step=options.step,
        curvature=options.curvature,
    )
    with ImageFolder(options.output, calibration) as folder:
        for pair in tqdm(
            pairs,
            total=options.frames,
            unit="pair",
            delay=1.0,
            leave=False,
            disable=not sys.stderr.isatty(),
        ):
            folder.write(pair.number, pair.images, pair.insertion, pair.truth, pair.share_seen)
    wall = time.perf_counter() - begin
    print(f"{options.frames} pairs of {options.scenario.name} in {options.output}, {wall:.1f} s")
    if options.json is not None:
        result: dict[str, JsonValue] = {
            "scenario": options.scenario.name,
            "frames": options.frames,
            "seed": options.seed,
            "output": str(options.output),
            "wall_s": wall,
        }
        write_json(options.json, result)
    return EXIT_DONE


def parse(arguments: Sequence[str]) -> RenderOptions:
    """Return the options of a command line (without the program's name).

    Raises
    ------
    UserError
        Anything that cannot be rendered as asked.
    """
    given = _parser().parse_args(arguments)
    depth = number("--depth-mm", given.depth_mm, 1.0, 300.0, "mm") / 1e3
    step = number("--step-mm", given.step_mm, 0.001, 50.0, "mm") / 1e3
    frames = math.ceil(depth / step - 1e-9) + 1
    if given.frames is not None:
        frames = whole_number("--frames", given.frames, 1, 999_999)
    scenario = find_scenario(given.scenario)
    if given.noise is not None:
        noise = number("--noise", given.noise, 0.0, 50.0, "grey levels")
        scenario = dataclasses.replace(scenario, noise=noise)
    return RenderOptions(
        output=Path(given.output).expanduser(),
        scenario=scenario,
        frames=frames,
        seed=whole_number("--seed", given.seed, 0, 2**31 - 1),
        depth=depth,
        step=step,
        curvature=number("--curvature", given.curvature, 0.0, 100.0, "1/m"),
        calibration=None if given.calibration is None else Path(given.calibration).expanduser(),
        json=output_file("--json", given.json),
    )


def _parser() -> CommandParser:
    parser = CommandParser(
        "render_images",
        DESCRIPTION,
        "scenarios:\n"
        + "".join(f"  {name:15}{one.summary}\n" for name, one in SCENARIOS.items())
        + "\n"
        + EPILOG,
    )
    add = parser.add_argument
    add("--output", required=True, metavar="DIR", help="new or empty folder")
    add("--scenario", default="clean", metavar="NAME", help="see below (default: clean)")
    add("--frames", metavar="N", help="how many pairs (default: to the depth)")
    add("--seed", default="0", metavar="N", help="keys path and images (default: 0)")
    add("--depth-mm", default="120", metavar="D", help="where the stage stops (default: 120)")
    add("--step-mm", default="1", metavar="S", help="insertion between frames (default: 1)")
    add(
        "--curvature",
        default=repr(CURVATURE),
        metavar="K",
        help=f"of the needle's path [1/m] (default: {CURVATURE:.3f})",
    )
    add("--noise", metavar="SIGMA", help="of the sensor [grey levels] (default: the scenario's)")
    add("--calibration", metavar="FILE", help="of the cameras (default: needle_tracker's own)")
    add("--json", metavar="FILE", help="write what was done as one flat JSON object")
    return parser


if __name__ == "__main__":
    sys.exit(main())
