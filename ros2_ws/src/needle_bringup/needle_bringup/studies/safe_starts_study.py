"""The region of safe starts of a target past obstacles, as data and as a picture.

python -m needle_bringup.studies.safe_starts_study --target 4,-6,100 \
        --obstacles docs/obstacles.yaml --output safe_starts.png
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from needle_controller.planning.entry import SafeStarts, safe_starts
from needle_controller.planning.obstacles import Obstacles, read_obstacles
from needle_controller.presets.path_steering import path_planner
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, JsonValue, run_command, write_json
from needle_core.commands.options import CommandParser, join_start, number, output_file
from needle_core.errors import UserError

OFFSETS = np.linspace(-0.024, 0.024, 17)
ANGLES = np.radians(np.linspace(-16.0, 16.0, 17))
DEPTH = 0.2
_COLORS = ListedColormap(["#d9dde2", "#2e9d55"])


def draw(starts: SafeStarts) -> Figure:
    """Return the picture: safe offsets at the left, safe tilts at the right."""
    figure = Figure(figsize=(8.0, 3.8), layout="constrained")
    for place, (grid, safe, largest, names) in enumerate(
        (
            (starts.offsets * 1e3, starts.shifted, starts.largest_shift * 1e3, ("x", "y", "mm")),
            (
                np.degrees(starts.angles),
                starts.tilted,
                math.degrees(starts.largest_tilt),
                ("pitch", "yaw", "deg"),
            ),
        ),
        start=1,
    ):
        axes = figure.add_subplot(1, 2, place)
        axes.pcolormesh(grid, grid, safe, cmap=_COLORS, vmin=0, vmax=1, shading="nearest")
        axes.plot(0.0, 0.0, "+", color="black")
        first, second, unit = names
        axes.set(xlabel=f"{second} at the entry [{unit}]", ylabel=f"{first} at the entry [{unit}]")
        axes.set_title(f"safe within {largest:.1f} {unit}")
        axes.set_aspect("equal")
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; returns its exit code: 1 where the entry itself is not safe."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: _run(words))


def _run(words: Sequence[str]) -> int:
    parser = CommandParser("safe_starts_study", "How far the needle may be misplaced.", "")
    add = parser.add_argument
    add("--target", metavar="X_MM,Y_MM,Z_MM", help="where the needle is to go, from the entry")
    add("--obstacles", metavar="FILE", help="YAML file of spheres and capsules")
    add("--output", metavar="FILE.png", help="write the picture there")
    add("--json", metavar="FILE", help="write the figures there")
    given = parser.parse_args(join_start(words))
    if given.target is None:
        raise UserError("--target X_MM,Y_MM,Z_MM is missing")
    parts = given.target.split(",")
    if len(parts) != 3:
        raise UserError(f"--target {given.target!r} is not X_MM,Y_MM,Z_MM, such as 10,-5,100")
    target = [number("--target", part, -200.0, 200.0, "mm") * 1e-3 for part in parts]
    obstacles = Obstacles() if given.obstacles is None else read_obstacles(Path(given.obstacles))
    picture, figures = output_file("--output", given.output), output_file("--json", given.json)
    settings = SteeringSettings(depth=DEPTH)
    starts = safe_starts(
        path_planner(settings),
        target,
        obstacles,
        settings.curvature,
        offsets=OFFSETS,
        angles=ANGLES,
    )
    seen: dict[str, JsonValue] = {
        "safe_shift_mm": starts.largest_shift * 1e3,
        "safe_tilt_deg": math.degrees(starts.largest_tilt),
        "shifted_share": float(np.mean(starts.shifted)),
        "tilted_share": float(np.mean(starts.tilted)),
    }
    print(f"safe within {seen['safe_shift_mm']:.1f} mm of the entry, along z")
    print(f"safe within {seen['safe_tilt_deg']:.1f} deg of z, at the entry")
    if picture is not None:
        draw(starts).savefig(picture, dpi=110)
    if figures is not None:
        write_json(figures, seen)
    middle = len(OFFSETS) // 2
    return EXIT_DONE if starts.shifted[middle, middle] else EXIT_MISSED


if __name__ == "__main__":
    sys.exit(main())
