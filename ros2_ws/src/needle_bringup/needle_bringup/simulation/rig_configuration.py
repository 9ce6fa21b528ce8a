"""Parameters of the rig's nodes for one run, and checks of their consistency."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from needle_bringup.simulation.simulate_options import CIA402, SimulateOptions, command_of
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import specs
from needle_core.settings.parameter_files import Parameters
from needle_device_driver.supervisor.limits import SafetyLimits

# Node -> its package, in the order in which the nodes are started.
PACKAGES = {
    "recorder": "needle_bags",
    "sim_rig": "needle_sim",
    "drive_emulator": "needle_sim",
    "device_driver": "needle_device_driver",
    "stereo_tracker": "needle_tracker",
    "plane_controller": "needle_controller",
    "simulated_operator": "needle_bringup",
}
NODES = tuple(PACKAGES)
# Nodes that exist only at some levels -> these levels.
_LEVELS = {
    "drive_emulator": ("drive",),
    "device_driver": ("drive",),
    "stereo_tracker": ("camera", "drive"),
}

CONTINUOUS_CAMERA_RATE = 30.0
"""Camera rate of a continuous insertion [Hz]."""
# Minimum noise bound assumed by the controllers [m].
SMALLEST_NOISE = 1e-5

# Watchdog time of driver and drives when seven processes share the cores [s].
GRAPH_WATCHDOG = 0.5

CURVATURE, DIAMETER, PRE_BEND, LEAN = 1.0 / 0.122, 0.7e-3, math.radians(10.0), math.radians(5.6)
"""The needle of [KC09], every node's default: curvature [1/m], diameter [m], bend, lean [rad]."""
_SEARCHED = 1.1
"""Maximum curvature of the tracker's search, as a multiple of the needle's."""
_LEAN_MARGIN = math.radians(6.4)
"""Tolerance of the tracker for the lean of the visible end."""
_RELATIVE = 1e-3
_GATES = {("sim_rig", "curvature"): ("stereo_tracker", "max_curvature", 9.0)}


class Shared(NamedTuple):
    """Value that several nodes must share.

    Attributes
    ----------
    what, option : str
        Its name, and the option of `simulate` that sets it in all nodes.
    default : float or str
        Default of every node.
    unit : str
        Unit.
    names : dict of str to str
        Name of the parameter in each node.
    """

    what: str
    option: str
    default: float | str
    unit: str
    names: dict[str, str]


_CURVATURES = {"sim_rig": "curvature", "plane_controller": "curvature"}
_WIDTHS = {
    "sim_rig": "needle_diameter",
    "stereo_tracker": "needle_width",
    "plane_controller": "needle_diameter",
    "live_view": "needle_diameter",
}
_MOVING = ("device_driver", "live_view")
_FILES = {"sim_rig": "calibration_file", "stereo_tracker": "calibration_file"}
_JOINT_LIMITS = ("max_depth", "max_speed", "max_turns", "max_rotation_rate")
SHARED = (
    Shared("curvature", "--curvature", CURVATURE, "1/m", _CURVATURES),
    Shared("diameter", "--diameter-mm", DIAMETER, "m", _WIDTHS),
    Shared("calibration", "--params", "", "", _FILES),
    *(
        Shared(name, "--params", default, spec.unit, dict.fromkeys(_MOVING, name))
        for name, spec, default in specs(SafetyLimits)
        if name in _JOINT_LIMITS
    ),
)


def merge(*layers: Parameters) -> Parameters:
    """Return the merged layers; a parameter of a later layer replaces that of an earlier one."""
    merged: Parameters = {}
    for layer in layers:
        for node, values in layer.items():
            merged[node] = {**merged.get(node, {}), **values}
    return merged


def nodes_of(options: SimulateOptions) -> tuple[str, ...]:
    """Return the nodes that a run needs."""
    return tuple(node for node in NODES if options.level in _LEVELS.get(node, (options.level,)))


def command_line_parameters(
    options: SimulateOptions, bag: Path, command: str | None = None
) -> Parameters:
    """Return the parameters that the command line sets in the nodes of the run.

    Parameters
    ----------
    options : SimulateOptions
        The command line.
    bag : Path
        The bag's folder.
    command : str, optional
        Command that repeats the run; `simulate` with these options by default.
    """
    sim_rig: dict[str, Any] = {
        "level": options.level,
        "seed": options.seed,
        "initial_pitch": math.radians(options.initial_pitch_deg),
        "initial_roll": math.radians(options.initial_roll_deg),
        "torsion_play": math.radians(options.play_deg),
        "torsion_lag": options.lag_mm * 1e-3,
    }
    if options.noise_mm is not None:
        sim_rig["tip_noise"] = options.noise_mm * 1e-3
    driver: dict[str, Any] = {"link": "slcan", "channel": str(can_adapter())}
    if options.graph:
        driver["watchdog"] = driver["reply_age_limit"] = GRAPH_WATCHDOG
    information = {**run_info(options), "command": command or command_of(options)}
    parameters: Parameters = {
        "recorder": {"bag": str(bag), "run_info": json.dumps(information)},
        "sim_rig": sim_rig,
        "drive_emulator": {"pty": str(can_adapter())},
        "device_driver": driver,
        "stereo_tracker": {},
        "plane_controller": {
            "preset": options.controller,
            "depth": options.depth_mm * 1e-3,
            "target_offset": -options.initial_x_mm * 1e-3,
        },
        "simulated_operator": {"wait_for_recorder": options.graph},
    }
    own = {"estimator": options.estimator, "law": options.law, "planner": options.planner}
    parameters["plane_controller"].update({kind: name for kind, name in own.items() if name})
    if options.estimator:
        parameters["plane_controller"]["seed"] = options.seed
    if options.insertion == "continuous":
        sim_rig["camera_rate"] = CONTINUOUS_CAMERA_RATE
        parameters["plane_controller"]["insertion"] = options.insertion
    if options.target_mm is not None:
        point = [c * 1e-3 for c in options.target_mm]
        parameters["plane_controller"]["target_point"] = point
    if options.obstacles is not None:
        parameters["plane_controller"]["obstacles"] = _obstacles(options.obstacles)
    if options.noise_mm is not None:
        # Pass the sensor's noise bound to the controller.
        bound = max(options.noise_mm * 1e-3, SMALLEST_NOISE)
        parameters["plane_controller"]["tip_covariance"] = "configured"
        parameters["plane_controller"]["tip_noise"] = "bounded"
        parameters["plane_controller"]["tip_noise_bound"] = bound
        parameters["plane_controller"]["measurement_std"] = bound / math.sqrt(3.0)
    needle = needle_parameters(
        options.curvature,
        None if options.diameter_mm is None else options.diameter_mm * 1e-3,
        None if options.pre_bend_deg is None else math.radians(options.pre_bend_deg),
    )
    parameters = merge(parameters, needle, _of_drives(options))
    return {node: parameters[node] for node in nodes_of(options)}


def _of_drives(options: SimulateOptions) -> Parameters:
    """Return the parameters of driver and drives that depend on the type of the drives."""
    if options.drives == CIA402:
        return {}
    names = options.drives.split(",")
    kinds = {"insertion": names[0], "rotation": names[-1]}
    emulator: dict[str, Any] = {"drives": options.drives}
    driver: dict[str, Any] = {f"{axis}_drive": kind for axis, kind in kinds.items()}
    if options.graph:
        # Stay below the ports that the system assigns to outgoing connections.
        port = emulator["listen"] = 12_000 + 2 * (os.getpid() % 10_000)
        for index, kind in enumerate(dict.fromkeys(names)):
            if kind != CIA402:
                driver[f"{kind}_address"] = f"127.0.0.1:{port + index}"
    return {"drive_emulator": emulator, "device_driver": driver}


def _obstacles(path: Path) -> list[float]:
    """Return the obstacles of a file as plane_controller's parameter."""
    # Import late, because compiled code takes half a second to import.
    from needle_controller.planning.obstacles import read_obstacles  # noqa: PLC0415

    return [float(value) for value in read_obstacles(path).table.ravel()]


def can_adapter() -> Path:
    """Return the path of this process's emulated CAN adapter."""
    return Path(tempfile.gettempdir()) / f"needle_can_{os.getpid()}"


def refuse_reserved(path: Path, given: Parameters, options: SimulateOptions) -> None:
    """Reject a parameter file that conflicts with the command line.

    Raises
    ------
    UserError
        If the file sets a parameter that the command line sets.
    """
    reserved = command_line_parameters(options, Path())
    for node, values in given.items():
        for name in reserved[node].keys() & values.keys():
            raise UserError(
                f"{path}: {node}: {name} cannot be in the file: simulate sets it by its options"
            )


def run_info(options: SimulateOptions) -> dict[str, Any]:
    """Return the description of the run in the bag."""
    info = dataclasses.asdict(options)
    for name in ("bag", "params", "json"):
        del info[name]
    return {**info, "obstacles": None if options.obstacles is None else options.obstacles.name}


def write_parameters(path: Path, parameters: Parameters) -> None:
    """Write a ROS parameter file."""
    document = {node: {"ros__parameters": values} for node, values in parameters.items()}
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")


def needle_parameters(
    curvature: float | None, diameter: float | None, pre_bend: float | None
) -> Parameters:
    """Return the parameters of all nodes for a needle; None keeps the defaults.

    Parameters
    ----------
    curvature : float or None
        Curvature of the needle's path [1/m].
    diameter : float or None
        Diameter of the needle [m].
    pre_bend : float or None
        Angle between shaft and pre-bent end [rad]; its ratio to the lean is that of [KC09].
    """
    sim_rig: dict[str, Any] = {}
    tracker: dict[str, Any] = {}
    controller: dict[str, Any] = {}
    if curvature is not None:
        sim_rig["curvature"] = controller["curvature"] = curvature
        tracker["max_curvature"] = _SEARCHED * curvature
    if diameter is not None:
        sim_rig["needle_diameter"] = controller["needle_diameter"] = diameter
        tracker["needle_width"] = diameter
    if pre_bend is not None:
        lean = pre_bend * LEAN / PRE_BEND
        sim_rig["pre_bend"], sim_rig["pre_bend_lean"] = pre_bend, lean
        tracker["tip_lean"] = lean + _LEAN_MARGIN
    return {"sim_rig": sim_rig, "stereo_tracker": tracker, "plane_controller": controller}


def contradictions(parameters: Parameters, nodes: Sequence[str]) -> list[str]:
    """Return a line for each difference between the needle parameters of the nodes.

    Parameters
    ----------
    parameters : dict
        Parameters of all nodes; missing ones have the default.
    nodes : sequence of str
        Names of the running nodes.
    """
    found = []
    for shared in SHARED:
        values = {
            (node, name): parameters.get(node, {}).get(name, shared.default)
            for node, name in shared.names.items()
            if node in nodes
        }
        first = next(iter(values.values()), None)
        if all(_alike(value, first) for value in values.values()):
            continue
        listed = ", ".join(
            f"{node} has {name} {_shown(value, shared.unit)}"
            for (node, name), value in values.items()
        )
        found.append(f"{shared.what} differs: {listed} ({shared.option} sets it in all nodes)")
    for (node, name), (other, gate, default) in _GATES.items():
        limit = parameters.get(other, {}).get(gate, default)
        value = parameters.get(node, {}).get(name, CURVATURE)
        if other in nodes and isinstance(value, float) and value > limit:
            found.append(f"{node} has {name} {value:g}, but {other} expects {gate} {limit:g}")
    return found


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_RELATIVE)
    return bool(one == other)


def _shown(value: Any, unit: str) -> str:
    return f"{value:.4g} {unit}" if isinstance(value, float) else repr(value)
