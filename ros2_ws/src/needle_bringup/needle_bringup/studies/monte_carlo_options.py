"""Command line of `monte_carlo`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from needle_bringup.simulation.simulate_options import add_own_part_options
from needle_bringup.studies.disturbance_options import add_disturbance_options, disturbances_of
from needle_controller.presets.steering_settings import PRESETS
from needle_core.commands.options import (
    CommandParser,
    join_signed_values,
    number,
    output_file,
    start,
    whole_number,
)
from needle_core.errors import UserError
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.study import GRIDS, StartBounds

DESCRIPTION = """\
Steer many simulated needles to the plane x = 0, and count those that converge.

The default is the study of [KC09]: 10 x 10 x 10 starts (x, pitch and roll up to the given bounds,
roll centred on 0), 10 runs each with different noise, 120 mm deep, +-1 mm noise on each coordinate
of the tip. A tip is measured before the first step and after every step of --step-mm; the figures
use the true tip. Disturbances affect only the plant: the controller knows --delay, and assumes the
noise of --claimed-mm.
"""

EPILOG = """\
figures (all in --json FILE, null if not applicable):
  converged_at_end    share of runs that end within +-1 mm of the plane
  converged_last_20   share within +-1 mm after each of the last 20 steps
  rms, p95, max       distance from the plane over the last 20 steps of all runs
  settle              insertion of the last entry into +-1 mm, of the runs that end inside
  rotation_mean       mean over the runs of the total rotation of the base, in both directions
  wall_s, cpu_s       elapsed and processor time of the study (waiting threads of numpy count too,
                      unless OPENBLAS_NUM_THREADS=1)
  diverged            share that ends outside, farther away than its start, and still moving away
  inside_N_sigma      share of x and pitch (mean of both shares) within N of the estimate's standard
                      deviations from the true value, over the last 20 steps of all runs; null for
                      paper and open_loop, which do not use them; x_inside_3_sigma is for x alone
  doubtful_at_end     share whose final estimate has a probability above 5 % of an error above 1 mm
  trusted_far_off     number of runs that end more than 5 mm away and are not doubtful
with --targets, instead of those for the plane:
  rms_point           final distance of the tip from its point (p95 and max likewise)
  within_1_mm_point   share that ends within 1 mm of its point; a point counts as reachable if the
                      arc to it from the true start needs at most 0.6 of the curvature

examples:
  ros2 run needle_sim monte_carlo --controller paper --grid cell --json paper.json
  ros2 run needle_sim monte_carlo --controller open_loop --initial=-3,2,15 --draws 1
  ros2 run needle_sim monte_carlo --noise-mm 0.58 --noise-shape normal
  ros2 run needle_sim monte_carlo --outliers 0.05 --outlier-mm 2,3.5 --slip 0.02 --bump-mm 2
  ros2 run needle_sim monte_carlo --targets 2000 --rotation-deg 800 --csv points.csv
  ros2 run needle_sim monte_carlo --targets 2000 --target-drift-mm-per-s 0.03 --target-breath-mm 3
  ros2 run needle_sim monte_carlo --targets 2000 --controller sliding_mode
  ros2 run needle_sim monte_carlo --estimator particle_filter --draws 1
  ros2 run needle_sim monte_carlo --draws 1000 --scheduler tcp://10.0.0.5:8786 --csv runs.csv

exit codes: 0 done; 2 invalid or missing input; 130 interrupted
"""

_DEPTH_MM, _DEPTH_OF_POINTS_MM = "120", "150"
# Options of the study that are not options of each run.
_STUDY_OPTIONS = (
    "grid", "draws", "x_mm", "pitch_deg", "roll_deg", "initial", "targets",
    "scheduler", "json", "csv",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class MonteCarloOptions:
    """Options of a study, in SI units.

    `run_options` contains the options of each run except its start and target point, as typed.
    """

    controller: str
    estimator: str
    law: str
    planner: str
    grid: str
    draws: int
    bounds: StartBounds
    initial: tuple[float, float, float] | None
    depth: float
    step_length: float
    disturbances: Disturbances
    claimed_bound: float
    sigma_scale: float
    flips: int
    turn_delay: float
    targets: int
    rotation_budget: float
    target_drift: float
    target_breath: float
    seed: int
    scheduler: str
    json: Path | None
    csv: Path | None
    run_options: Mapping[str, str]


def parse(arguments: Sequence[str]) -> MonteCarloOptions:
    """Return the options of a command line (without the program's name).

    Raises
    ------
    UserError
        If an option is invalid.
    """
    given = _parser().parse_args(join_signed_values(arguments))
    if given.grid not in GRIDS:
        raise UserError(f"--grid {given.grid!r} is not one of {', '.join(GRIDS)}")
    if given.targets != "0" and given.turn_delay_mm != "0":
        raise UserError("--turn-delay-mm is for needles that are steered to the plane")
    if given.planner and given.targets == "0":
        raise UserError("--planner applies to --targets only")
    if (given.planner or given.law) and given.controller not in PRESETS:
        raise UserError(
            f"--controller {given.controller} is a law; it cannot be combined with another one"
        )
    depth = given.depth_mm or (_DEPTH_MM if given.targets == "0" else _DEPTH_OF_POINTS_MM)
    return MonteCarloOptions(
        controller=given.controller,
        estimator=given.estimator,
        law=given.law,
        planner=given.planner,
        grid=given.grid,
        draws=whole_number("--draws", given.draws, 1, 1000),
        bounds=StartBounds(
            x=number("--x-mm", given.x_mm, 0.0, 100.0, "mm") * 1e-3,
            pitch=math.radians(number("--pitch-deg", given.pitch_deg, 0.0, 80.0, "deg")),
            roll=math.radians(number("--roll-deg", given.roll_deg, 0.0, 180.0, "deg")),
        ),
        initial=None if given.initial is None else _initial(given.initial),
        depth=number("--depth-mm", depth, 1.0, 1000.0, "mm") * 1e-3,
        step_length=number("--step-mm", given.step_mm, 0.1, 10.0, "mm") * 1e-3,
        disturbances=disturbances_of(given),
        claimed_bound=number("--claimed-mm", given.claimed_mm, 0.01, 100.0, "mm") * 1e-3,
        sigma_scale=number("--sigma-scale", given.sigma_scale, 0.01, 100.0, "-"),
        flips=whole_number("--flips", given.flips, 0, 100),
        turn_delay=number("--turn-delay-mm", given.turn_delay_mm, 0.0, 0.9, "mm") * 1e-3,
        targets=whole_number("--targets", given.targets, 0, 1_000_000),
        rotation_budget=math.radians(number("--rotation-deg", given.rotation_deg, 0.0, 1e6, "deg")),
        target_drift=1e-3
        * number("--target-drift-mm-per-s", given.target_drift_mm_per_s, 0.0, 10.0, "mm/s"),
        target_breath=number("--target-breath-mm", given.target_breath_mm, 0.0, 100.0, "mm") * 1e-3,
        seed=whole_number("--seed", given.seed, 0, 2**31 - 1),
        scheduler=given.scheduler,
        json=output_file("--json", given.json),
        csv=output_file("--csv", given.csv),
        run_options=_run_options({**vars(given), "depth_mm": depth}),
    )


def _run_options(given: Mapping[str, str]) -> Mapping[str, str]:
    """Return the options of every run; `rotation_deg` is renamed, as a result has this name."""
    renamed = {"rotation_deg": "most_rotation_deg"}
    return {
        renamed.get(name, name): value or ""
        for name, value in given.items()
        if name not in _STUDY_OPTIONS
    }


def _parser() -> CommandParser:
    parser = CommandParser("monte_carlo", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add(
        "--controller",
        default="best",
        metavar="NAME",
        help="best, paper or open_loop; with --targets best, or one of the published laws "
        "sliding_mode and rrt with the estimator of best (default: best)",
    )
    add_own_part_options(add, "--targets")
    add(
        "--grid",
        default="endpoint",
        metavar="endpoint|cell|random",
        help="starts up to the bounds, at the centres of cells, or random (default: endpoint)",
    )
    numbers = (
        ("--draws", "10", "N", "runs per start"),
        ("--claimed-mm", "1", "C", "maximum tip error that the controller assumes [mm]"),
        (
            "--sigma-scale",
            "1",
            "S",
            "other than 1: each tip has a covariance instead of a bound, that of uniform noise "
            "within --claimed-mm with standard deviations S times too small",
        ),
        ("--x-mm", "3", "X", "bound of the initial distance from the plane [mm]"),
        ("--pitch-deg", "10", "P", "bound of the initial pitch [deg]"),
        ("--roll-deg", "30", "R", "bound of the initial roll [deg]"),
        ("--flips", "0", "N", "number of flips of the bevel, at equal distances, mirrored"),
        (
            "--turn-delay-mm",
            "0",
            "D",
            "insertion between a measurement and its rotation [mm]: speed x latency in continuous "
            "insertion; not with --targets",
        ),
        (
            "--targets",
            "0",
            "N",
            "steer N needles to points instead of the plane: each from a random start within the "
            "bounds to its own random point, 60 to 120 mm ahead",
        ),
        ("--rotation-deg", "1e6", "B", "maximum total rotation of each base to its point [deg]"),
        (
            "--target-drift-mm-per-s",
            "0",
            "V",
            "drift speed of each point in its own direction [mm/s], if inserted at 2 mm/s",
        ),
        (
            "--target-breath-mm",
            "0",
            "A",
            "amplitude of each point's oscillation at 0.2 Hz in another direction [mm]",
        ),
        ("--step-mm", "1", "L", "insertion between exposures [mm], known to the controller"),
        ("--seed", "1", "N", "seed of all random numbers; the same seed gives the same figures"),
    )
    for name, default, metavar, text in numbers:
        add(name, default=default, metavar=metavar, help=f"{text} (default: {default})")
    add_disturbance_options(parser)
    add(
        "--depth-mm",
        metavar="D",
        help=f"final insertion [mm], the maximum with --targets (default: {_DEPTH_MM}; with "
        f"--targets {_DEPTH_OF_POINTS_MM})",
    )
    add(
        "--initial",
        metavar="X_MM,PITCH_DEG,ROLL_DEG",
        help="start all runs from this pose instead of a grid",
    )
    add(
        "--scheduler",
        default="",
        metavar="ADDRESS",
        help="run on the Dask cluster of this scheduler, such as tcp://10.0.0.5:8786, with the "
        "same figures (docs/several_computers.md)",
    )
    add("--json", metavar="FILE", help="also write the figures as flat JSON")
    add("--csv", metavar="FILE", help="write a line per run: its options, start and results")
    return parser


def _initial(text: str) -> tuple[float, float, float]:
    x_mm, pitch_deg, roll_deg = start(text, largest_x=100.0, largest_pitch=80.0)
    return x_mm * 1e-3, math.radians(pitch_deg), math.radians(roll_deg)
