"""Command line of `simulate`."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from needle_core.commands.options import (
    CommandParser,
    join_signed_values,
    number,
    output_file,
    start,
    whole_number,
)
from needle_core.errors import UserError

DESCRIPTION = """\
Steer a simulated needle into a plane with the rig's components, record the run and report on it.

sim_rig, stereo_tracker, plane_controller, simulated_operator and, at level drive, drive_emulator
and device_driver run in one process on a virtual clock: the same seed gives the same bag, byte for
byte. With --graph they and the recorder are ROS nodes in separate processes.

Shows the progress, and writes a folder with the bag (for rosbags, mcap, Foxglove, PlotJuggler or
`ros2 bag`), report.html with its figures, summary.json, the parameters and, with --graph, the logs.
"""

EPILOG = """\
examples:
  scripts/simulate
      camera images, controller best, start 3 mm from the plane, 120 mm deep
  scripts/simulate --level tip --seed 7
      no images: tips with the noise of the paper, +-1 mm; faster
  scripts/simulate --level drive
      camera images, and the device driver moves two emulated CANopen drives
  scripts/simulate --controller open_loop --level tip --noise-mm 0
      no steering: the needle ends 14.6 mm from the plane (exit code 1)
  scripts/simulate --initial=5,-4,30 --depth-mm 80 --bag bags/my_run
      start 5 mm above the plane, pitched down by 4 deg, rolled by 30 deg
  scripts/simulate --target 10,-5,100
      to a point 100 mm deep, 10 mm above the entry and 5 mm to its side
  scripts/simulate --target 4,-6,100 --obstacles obstacles.yaml
      around spheres and capsules, such as
        frame: rig
        spheres: [{center: [0.002, -0.003, 0.055], radius: 0.003}]
        capsules: [{start: [-0.02, 0.006, 0.07], end: [0.02, 0.006, 0.07], radius: 0.003}]
  scripts/simulate --curvature 4 --diameter-mm 1 --pre-bend-deg 6
      another needle, in simulation, tracker and controller; contradictory --params cause a warning
  scripts/simulate --level tip --estimator particle_filter
      with an estimator of another package (docs/own_controllers.md)
  scripts/simulate --params my_rig.yaml
      with a ROS parameter file that overrides the rig's configuration, such as
        plane_controller: {ros__parameters: {max_rotation_per_length: 300.0}}

exit codes: 0 converged (final tip within 1 mm of the plane or point); 1 not converged; 2 invalid or
missing input; 130 interrupted
"""

LEVELS = ("tip", "camera", "drive")
CIA402 = "cia402"
# Presets and insertion modes of plane_controller, repeated because its import takes half a second.
CONTROLLERS = ("best", "paper", "open_loop")
INSERTIONS = ("stepwise", "continuous")

DEPTH_MM, LARGEST_DEPTH_MM = "120", 150.0
# Options that command_of() omits or formats specially.
_SPECIAL = (
    *("bag", "json", "level", "controller", "seed", "target_mm", "graph", "component"),
    *("initial_x_mm", "initial_pitch_deg", "initial_roll_deg"),
)


@dataclasses.dataclass(frozen=True)
class SimulateOptions:
    """Options of `simulate`, in mm and degrees as on the command line."""

    level: str = "camera"
    controller: str = "best"
    estimator: str = ""
    law: str = ""
    planner: str = ""
    insertion: str = "stepwise"
    drives: str = CIA402
    seed: int = 1
    initial_x_mm: float = -3.0
    initial_pitch_deg: float = 2.0
    initial_roll_deg: float = 15.0
    noise_mm: float | None = None
    depth_mm: float = 120.0
    target_mm: tuple[float, float, float] | None = None
    obstacles: Path | None = None
    curvature: float | None = None
    diameter_mm: float | None = None
    pre_bend_deg: float | None = None
    play_deg: float = 0.0
    lag_mm: float = 0.0
    real_time_factor: float = 0.0
    graph: bool = False
    component: tuple[str, ...] = ()
    bag: Path | None = None
    params: Path | None = None
    json: Path | None = None


def parse(arguments: Sequence[str]) -> SimulateOptions:
    """Return the options of a command line (without the program's name).

    Raises
    ------
    UserError
        If an option is invalid.
    """
    given = _parser().parse_args(join_signed_values(arguments))
    _one_of("--level", given.level, LEVELS)
    _one_of("--controller", given.controller, CONTROLLERS)
    _one_of("--insertion", given.insertion, INSERTIONS)
    noise = None
    if given.level == "tip":
        noise = number("--noise-mm", given.noise_mm or "1.0", 0.0, 20.0, "mm")
    elif given.noise_mm is not None:
        raise UserError(f"--noise-mm applies to --level tip only, not with {given.level}")
    if given.drives is not None and given.level != "drive":
        raise UserError(f"--drives applies to --level drive only, not with {given.level}")
    x_mm, pitch_deg, roll_deg = start(given.initial, largest_x=50.0, largest_pitch=45.0)
    target = None if given.target is None else _target(given.target)
    for option in ("planner", "obstacles"):
        if getattr(given, option) and target is None:
            raise UserError(f"--{option} applies to --target only")
    depth = given.depth_mm or (DEPTH_MM if target is None else f"{LARGEST_DEPTH_MM:g}")
    factor = number("--real-time-factor", given.real_time_factor or "0", 0.0, 100.0, "-")
    if given.graph and given.real_time_factor is not None and factor != 1.0:
        raise UserError(
            f"--real-time-factor {given.real_time_factor} excludes --graph: processes run "
            "in real time"
        )
    return SimulateOptions(
        level=given.level,
        controller=given.controller,
        estimator=given.estimator,
        law=given.law,
        planner=given.planner,
        insertion=given.insertion,
        drives=given.drives or CIA402,
        initial_x_mm=x_mm,
        initial_pitch_deg=pitch_deg,
        initial_roll_deg=roll_deg,
        noise_mm=noise,
        depth_mm=number("--depth-mm", depth, 1.0, LARGEST_DEPTH_MM, "mm"),
        target_mm=target,
        obstacles=_readable("--obstacles", given.obstacles),
        curvature=_optional("--curvature", given.curvature, 0.1, 45.0, "1/m"),
        diameter_mm=_optional("--diameter-mm", given.diameter_mm, 0.2, 3.0, "mm"),
        pre_bend_deg=_optional("--pre-bend-deg", given.pre_bend_deg, 0.0, 25.0, "deg"),
        play_deg=number("--play-deg", given.play_deg, 0.0, 90.0, "deg"),
        lag_mm=number("--lag-mm", given.lag_mm, 0.0, 100.0, "mm"),
        real_time_factor=1.0 if given.graph else factor,
        graph=given.graph,
        component=_components(given),
        seed=whole_number("--seed", given.seed, 0, 2**31 - 1),
        bag=_new_bag(given.bag),
        params=_readable("--params", given.params),
        json=output_file("--json", given.json),
    )


def command_of(options: SimulateOptions) -> str:
    """Return the command that repeats a run with a new bag.

    It contains level, controller, seed and all options that differ from the default.

    Parameters
    ----------
    options : SimulateOptions
        Options of the run.
    """
    plain = SimulateOptions(
        noise_mm=1.0 if options.level == "tip" else None,
        depth_mm=float(DEPTH_MM) if options.target_mm is None else LARGEST_DEPTH_MM,
    )
    start_mm_deg = (options.initial_x_mm, options.initial_pitch_deg, options.initial_roll_deg)
    argv = [f"--level={options.level}", f"--controller={options.controller}"]
    argv.append(f"--seed={options.seed}")
    if start_mm_deg != (plain.initial_x_mm, plain.initial_pitch_deg, plain.initial_roll_deg):
        argv.append(f"--initial={_joined(start_mm_deg)}")
    if options.target_mm is not None:
        argv.append(f"--target={_joined(options.target_mm)}")
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name not in _SPECIAL and value != getattr(plain, field.name):
            argv.append(f"--{field.name.replace('_', '-')}={value}")
    if options.graph:
        argv.append("--graph")
    argv += [f"--component={name}" for name in options.component]
    return shlex.join(["scripts/simulate", *argv])


def _joined(numbers: Sequence[float]) -> str:
    return ",".join(map(str, numbers))


def _parser() -> CommandParser:
    parser = CommandParser("simulate", DESCRIPTION, EPILOG)
    add = parser.add_argument
    add(
        "--level",
        default="camera",
        metavar="tip|camera|drive",
        help="what is simulated: the measured tips; the stereo images; or the images and the "
        "drives, which the device driver moves (default: camera)",
    )
    add(
        "--drives",
        metavar="NAME[,NAME]",
        help="drives of both axes, or of insertion and rotation: cia402, galil, zaber, stepdir, "
        "or those of another package",
    )
    add(
        "--controller",
        default="best",
        metavar="paper|best|open_loop",
        help="preset that rotates the needle: the paper's, this project's best, or none (default: "
        "best)",
    )
    add_own_part_options(add, "--target")
    add(
        "--insertion",
        default="stepwise",
        metavar="|".join(INSERTIONS),
        help="rest after each step until the tip is measured, or advance throughout the hold "
        "(default: stepwise)",
    )
    add(
        "--initial",
        default="-3,2,15",
        metavar="X_MM,PITCH_DEG,ROLL_DEG",
        help="initial pose of the needle relative to the target plane (default: -3,2,15)",
    )
    add(
        "--noise-mm",
        metavar="A",
        help="level tip: maximum error of each measured coordinate [mm] (default: 1.0)",
    )
    add(
        "--depth-mm",
        metavar="D",
        help=f"final insertion [mm] (default: {DEPTH_MM}); with --target the maximum (default: "
        f"{LARGEST_DEPTH_MM:g})",
    )
    add(
        "--target",
        metavar="X_MM,Y_MM,Z_MM",
        help="steer to this point instead of the plane: X up, Z along the insertion, from the "
        "entry point",
    )
    add(
        "--obstacles",
        metavar="FILE",
        help="with --target: YAML file of spheres and capsules that the needle must not touch",
    )
    add(
        "--curvature",
        metavar="K",
        help="curvature of the needle's path in the tissue [1/m], in all nodes (default: 8.197, a "
        "radius of 122 mm)",
    )
    add(
        "--diameter-mm",
        metavar="D",
        help="diameter of the needle [mm], in all nodes (default: 0.7)",
    )
    add(
        "--pre-bend-deg",
        metavar="A",
        help="angle between the needle's shaft and its last 9 mm [deg], in all nodes; 0: straight "
        "(default: 10)",
    )
    add(
        "--play-deg",
        default="0",
        metavar="D",
        help="tissue: dead band between base and tip angle, +-D [deg] (default: 0)",
    )
    add(
        "--lag-mm",
        default="0",
        metavar="L",
        help="tissue: first-order lag of the tip angle, as inserted length [mm] (default: 0)",
    )
    add(
        "--real-time-factor",
        metavar="F",
        help="speed relative to real time; 0: as fast as possible, repeatable (default: 0)",
    )
    add(
        "--graph",
        action="store_true",
        help="run each component as a ROS node in its own process, over DDS, in real time",
    )
    add(
        "--component",
        action="append",
        default=[],
        metavar="MODULE:NAME",
        help="add a component of your own (docs/own_controllers.md); may be repeated",
    )
    add("--bag", metavar="DIR", help="new folder for the run (default: time-stamped, in bags/)")
    add("--params", metavar="FILE", help="ROS parameter file that overrides the configuration")
    add(
        "--seed",
        default="1",
        metavar="N",
        help="seed of all random numbers; the same seed gives the same run (default: 1)",
    )
    add("--json", metavar="FILE", help="also write the result as flat JSON")
    return parser


def _components(given: Any) -> tuple[str, ...]:
    for name in given.component:
        if given.graph:
            raise UserError(f"--component {name} excludes --graph")
        if not all(name.partition(":")):
            raise UserError(f"--component {name!r} is not MODULE:NAME, such as my_probe:Probe")
    return tuple(given.component)


def _target(text: str) -> tuple[float, float, float]:
    parts = text.split(",")
    if len(parts) != 3:
        raise UserError(f"--target {text!r} is not X_MM,Y_MM,Z_MM, such as 10,-5,100")
    return (
        number("--target X_MM", parts[0], -150.0, 150.0, "mm"),
        number("--target Y_MM", parts[1], -150.0, 150.0, "mm"),
        number("--target Z_MM", parts[2], 1.0, 150.0, "mm"),
    )


def _optional(name: str, text: str | None, lower: float, upper: float, unit: str) -> float | None:
    return None if text is None else number(name, text, lower, upper, unit)


def _one_of(name: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise UserError(f"{name} {value!r} is not one of {', '.join(known)}")


def _new_bag(text: str | None) -> Path | None:
    if text is None:
        return None
    path = Path(text).expanduser()
    # A dangling link also prevents the folder from being created.
    if path.exists() or path.is_symlink():
        raise UserError(f"--bag {text}: exists already; give a new folder")
    return path.absolute()


def _readable(name: str, text: str | None) -> Path | None:
    return None if text is None else existing_file(f"{name} ", text)


def existing_file(given_by: str, text: str) -> Path:
    """Return an existing file.

    Parameters
    ----------
    given_by : str
        Prefix for the error message: `--params `, `params:=`.
    text : str
        Path of the file.

    Raises
    ------
    UserError
        If it is a folder or does not exist.
    """
    path = Path(text).expanduser()
    if not path.is_file():
        what = "a folder, not a file" if path.is_dir() else "no such file"
        raise UserError(f"{given_by}{text}: {what}")
    return path


def add_own_part_options(add: Callable[..., Any], points: str) -> None:
    """Add `--estimator`, `--law` and `--planner`; `points` is the option that planners require."""
    for option, what in (
        ("--estimator", "estimator"),
        ("--law", "control law"),
        ("--planner", f"with {points}: planner"),
    ):
        add(
            option,
            default="",
            metavar="NAME",
            help=f"{what} of another package, by the name of its entry point "
            "(docs/own_controllers.md)",
        )
