"""Plans for generated scenes with obstacles, before insertion: found, how soon, how clear.

python -m campaign.steering.plan_study --scenes 300 --seed 909
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from campaign.steering.obstacle_scenes import ObstacleScene, make_scene
from campaign.steering.obstacle_study import CURVATURE, print_figures, study_parser
from needle_controller.planning.entry import entry_state
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_evaluation import PathSettings
from needle_controller.planning.path_planner import NeedlePath, PathPlanner
from needle_controller.planning.path_search import THOROUGH_STARTS
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.commands.options import number, output_file, whole_number

LABELS = {
    "scenes": "scenes",
    "found": "paths found",
    "found_quickly": "  by the quick search",
    "none_exists": "no path, as the flood fill proves",
    "none_found": "none found, by the thorough search neither",
    "first_p50_ms": "first plan, where the quick search finds it, 50 % [ms]",
    "first_p95_ms": "  95 %",
    "quick_p50_ms": "quick search, found or not, 50 % [ms of one core]",
    "quick_p95_ms": "  95 %",
    "thorough_p50_ms": "thorough search where it is asked, 50 % [ms]",
    "thorough_p95_ms": "  95 %",
    "fill_p50_ms": "flood fill, 50 % [ms]",
    "fill_p95_ms": "  95 %",
    "least_clearance_mm": "least clearance of a path's axis [mm]",
    "median_clearance_mm": "  median over the paths",
    "within_tolerance_only": "paths that pass the target, within the tolerance",
}


def scene_obstacles(scene: ObstacleScene) -> Obstacles:
    """Return a scene's obstacles as the planner takes them."""
    return Obstacles(
        [
            Obstacle((row[0], row[1], row[2]), (row[3], row[4], row[5]), row[6])
            for row in scene.obstacles.tolist()
        ]
    )


def study(scenes: int, seed: int, radius: float, tolerance: float) -> dict[str, float | None]:
    """Return the figures of some scenes, by the names of `LABELS`.

    Parameters
    ----------
    scenes, seed : int
        How many, and the key of all randomness.
    radius : float
        Least of a path [m]; the heading at the entry is known, and the axis keeps 0.75 mm clear.
    tolerance : float
        Distance from the target that a path may pass it by [m].
    """
    planner = PathPlanner(
        PathSettings(
            SteeringSettings.max_rotation_per_length,
            curvature_share=1.0,
            gentle_share=1.0,
            goal_tolerance=tolerance,
        )
    )
    entry = entry_state(1.0 / radius)
    times: dict[str, list[float]] = {"first": [], "quick": [], "fill": [], "thorough": []}

    def timed(what: str, asked: Callable[[], NeedlePath | bool | None]) -> NeedlePath | bool | None:
        begin = time.thread_time()
        answer = asked()
        times[what].append(1e3 * (time.thread_time() - begin))
        return answer

    paths: list[NeedlePath] = []
    found_quickly = none_exists = 0
    planner.warm_up()
    for n in range(scenes):
        scene = make_scene(seed, n, curvature=CURVATURE, pitch_bound=0.0, roll_bound=0.0)
        problem = entry, scene.target, scene_obstacles(scene)
        path = timed("quick", lambda: planner.path(*problem))  # noqa: B023 - called at once
        if path is not None:
            found_quickly += 1
            times["first"].append(times["quick"][-1])
        if path is None and not timed("fill", lambda: planner.may_have_path(*problem)):  # noqa: B023
            none_exists += 1
            continue
        if path is None:
            path = timed("thorough", lambda: planner.path(*problem, starts=THOROUGH_STARTS))  # noqa: B023
        if isinstance(path, NeedlePath):
            paths.append(path)
    clear = [1e3 * (path.margin + planner.settings.least_clearance) for path in paths]

    def quantile(values: Sequence[float], percent: float) -> float | None:
        return float(np.percentile(values, percent)) if values else None

    seen: dict[str, float | None] = {
        "scenes": scenes,
        "found": len(paths),
        "found_quickly": found_quickly,
        "none_exists": none_exists,
        "none_found": scenes - len(paths) - none_exists,
        "least_clearance_mm": quantile(clear, 0.0),
        "median_clearance_mm": quantile(clear, 50.0),
        "within_tolerance_only": sum(path.gentle_miss > 0.0 for path in paths),
    }
    for what, values in times.items():
        for percent in (50, 95):
            seen[f"{what}_p{percent}_ms"] = quantile(values, percent)
    return seen


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; returns its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: _run(words))


def _run(words: Sequence[str]) -> int:
    options = (
        ("--scenes", "300", "N", "number of scenes"),
        ("--seed", "909", "N", "seed of all random numbers"),
        ("--radius-mm", "135.6", "R", "minimum radius of a path"),
        ("--tolerance-mm", "1", "A", "accepted distance of a path from its target"),
    )
    given = study_parser(
        "plan_study", "Plan paths around generated obstacles.", options
    ).parse_args(words)
    path = output_file("--json", given.json)
    seen = study(
        whole_number("--scenes", given.scenes, 1, 100_000),
        whole_number("--seed", given.seed, 0, 2**31 - 1),
        number("--radius-mm", given.radius_mm, 20.0, 10_000.0, "mm") * 1e-3,
        number("--tolerance-mm", given.tolerance_mm, 0.0, 10.0, "mm") * 1e-3,
    )
    print_figures(LABELS, seen, path)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
