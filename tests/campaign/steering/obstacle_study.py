"""Generated scenes with obstacles: solvable, accepted and reached ones.

python -m campaign.steering.obstacle_study --scenes 1000 --seed 1
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from campaign.steering.obstacle_scenes import ObstacleScene, clearance, make_scene
from campaign.steering.path_search import find_path
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import next_step
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl
from needle_core.commands.cli import EXIT_DONE, run_command, write_json
from needle_core.commands.options import CommandParser, number, output_file, whole_number
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.se3 import FloatArray

NEEDLE_RADIUS = 0.00035
CURVATURE = SteeringSettings.curvature
SAMPLES = 4000
"""Random points of the search for a path."""
DEPTH = 0.2
ENTRY_ANGLE_STD = math.radians(2.0)
"""Standard deviation of the pitch at the entry that the controller assumes [rad]."""
_SUBSTEPS = 4
LABELS = {
    "scenes": "scenes",
    "solvable": "solvable with 90 % of the curvature, 0.75 mm clear",
    "solvable_reached": "  reached within 1 mm, of those solvable",
    "unsolvable": "no path found with all the curvature, 0.35 mm clear",
    "unsolvable_refused": "  refused before insertion, of those",
    "contacts": "needles that touched an obstacle",
    "update_p95_ms": "estimate, plan and law, 95 % [ms of one core]",
}


@dataclasses.dataclass(frozen=True)
class SceneOutcome:
    """End of a scene.

    Attributes
    ----------
    bare, solvable : bool
        Whether the search finds a path with all or 90 % of the curvature, 0.35 or 0.75 mm clear of
        everything.
    taken : bool
        Whether the controller started.
    miss : float
        True distance from the target at the end [m]; inf if it did not start.
    least : float
        Least clearance of the needle's surface [m]; inf if it did not start.
    """

    bare: bool
    solvable: bool
    taken: bool = False
    miss: float = math.inf
    least: float = math.inf


def solvability(scene: ObstacleScene, settings: SteeringSettings) -> SceneOutcome:
    """Return whether a scene has a path, as the outcome of a needle that did not start."""
    bare, solvable = (
        find_path(
            scene.target,
            scene.obstacles,
            share * CURVATURE,
            settings.max_rotation_per_length,
            clear,
            SAMPLES,
            1,
        )
        >= 0
        for share, clear in ((1.0, NEEDLE_RADIUS), (0.9, 0.00075))
    )
    return SceneOutcome(bare, solvable)


def steer(
    scene: ObstacleScene,
    solved: SceneOutcome,
    settings: SteeringSettings,
    rng: np.random.Generator,
    times: list[float],
) -> SceneOutcome:
    """Steer a needle through a scene as the node does; return the outcome.

    Parameters
    ----------
    scene, solved : ObstacleScene, SceneOutcome
        The scene, and its solvability.
    settings : SteeringSettings
        Settings of the controller; `tip_noise_bound` is also the largest error of a coordinate.
    rng : numpy.random.Generator
        Generator of the tips' noise.
    times : list of float
        List to which the CPU time of each update is appended [s].
    """
    obstacles = tuple(float(value) for value in scene.obstacles.ravel())
    control = PlaneControl(dataclasses.replace(settings, obstacles=obstacles))
    control.target_point = scene.target
    if control.path_problem(0.0):
        # The node would not start.
        return solved
    plant = NeedlePlant(initial_pose(scene.pitch, scene.roll), curvature=CURVATURE)
    noise = settings.tip_noise_bound
    joints, least = JointSample(0, 0.0, 0.0), math.inf
    for k in itertools.count(1):
        tip = _tip(plant) + rng.uniform(-noise, noise, 3)
        begin = time.thread_time()
        update = control.update(tip, joints)
        times.append(time.thread_time() - begin)
        step = None
        if update.command is not None and not update.blocked:
            step = next_step(joints, update.command, settings, slowly=False)
        if step is None:
            miss = float(np.linalg.norm(_tip(plant) - scene.target))
            return dataclasses.replace(solved, taken=True, miss=miss, least=least)
        length, turn = step.insertion - joints.insertion, step.rotation - joints.rotation
        for _ in range(_SUBSTEPS):
            plant.advance(length / _SUBSTEPS, turn / _SUBSTEPS)
            least = min(least, clearance(scene.obstacles, _tip(plant)) - NEEDLE_RADIUS)
        joints = JointSample(k, step.insertion, step.rotation)
    raise AssertionError


def study(scenes: int, seed: int, noise: float) -> dict[str, float | None]:
    """Return the figures of some scenes, by the names of `LABELS`.

    Parameters
    ----------
    scenes, seed : int
        Number of scenes, and seed of all random numbers.
    noise : float
        Largest error of a measured coordinate, which the controller assumes, too [m].
    """
    settings = SteeringSettings(
        depth=DEPTH,
        entry_angle_std=ENTRY_ANGLE_STD,
        tip_covariance="configured",
        tip_noise="bounded",
        tip_noise_bound=noise,
        measurement_std=noise / math.sqrt(3.0),
    )
    outcomes: list[SceneOutcome] = []
    times: list[float] = []
    for n in range(scenes):
        scene = make_scene(seed, n, CURVATURE)
        rng = np.random.default_rng([seed, n, 1])
        outcomes.append(steer(scene, solvability(scene, settings), settings, rng, times))
    return figures(outcomes, times)


def figures(outcomes: Sequence[SceneOutcome], times: Sequence[float]) -> dict[str, float | None]:
    """Return the figures of some outcomes, by the names of `LABELS`, as shares where possible."""

    def share(of: Sequence[SceneOutcome], what: Callable[[SceneOutcome], bool]) -> float | None:
        return sum(what(one) for one in of) / len(of) if of else None

    def reached(one: SceneOutcome) -> bool:
        return one.miss <= 1e-3

    solvable = [one for one in outcomes if one.solvable]
    # The search misses some paths: a scene whose needle arrived is solvable.
    unsolvable = [
        one
        for one in outcomes
        if not (one.bare or one.solvable or (reached(one) and one.least >= 0.0))
    ]
    return {
        "scenes": len(outcomes),
        "solvable": len(solvable),
        "solvable_reached": share(solvable, reached),
        "unsolvable": len(unsolvable),
        "unsolvable_refused": share(unsolvable, lambda one: not one.taken),
        "contacts": sum(one.least < 0.0 for one in outcomes),
        "update_p95_ms": 1e3 * float(np.percentile(times, 95.0)) if times else None,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; returns its exit code."""
    argv = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: _run(argv))


def _run(argv: Sequence[str]) -> int:
    parser = CommandParser("obstacle_study", "Steer needles around generated obstacles.", "")
    add = parser.add_argument
    add("--scenes", default="1000", metavar="N", help="number of scenes (1000)")
    add("--seed", default="1", metavar="N", help="seed of all random numbers (1)")
    add("--noise-mm", default="1", metavar="A", help="maximum error of each coordinate (1)")
    add("--json", metavar="FILE", help="also write the figures as flat JSON")
    given = parser.parse_args(argv)
    path = output_file("--json", given.json)
    result = study(
        whole_number("--scenes", given.scenes, 1, 100_000),
        whole_number("--seed", given.seed, 0, 2**31 - 1),
        number("--noise-mm", given.noise_mm, 0.01, 10.0, "mm") * 1e-3,
    )
    for name, label in LABELS.items():
        value = result[name]
        print(f"{label:55s}", "-" if value is None else f"{value:.4g}")
    if path is not None:
        write_json(path, {**result})
    return EXIT_DONE


def _tip(plant: NeedlePlant) -> FloatArray:
    return np.array(plant.T_rig_tip[:3, 3])


if __name__ == "__main__":
    sys.exit(main())
