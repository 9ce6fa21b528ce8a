"""The rig's parameters, and what one run changes in them."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

import yaml

from needle_bringup.simulation.needle_options import needle_parameters
from needle_bringup.simulation.simulate_options import SimulateOptions, command_of
from needle_core.errors import UserError
from needle_core.settings.parameter_files import Parameters

# Node -> its package, in the order in which they start.
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
# Nodes that not every level runs -> the levels that do.
_LEVELS = {
    "drive_emulator": ("drive",),
    "device_driver": ("drive",),
    "stereo_tracker": ("camera", "drive"),
}

CONTINUOUS_CAMERA_RATE = 30.0
"""Frames of a needle that goes on [1/s]."""
# A sensor without noise still has this bound for the controllers' design [m].
SMALLEST_NOISE = 1e-5

# Parameter that simulate sets -> the option that it comes from.
_ALIKE = ("level", "seed", "bag", "estimator", "law", "planner", "insertion", "obstacles")
OPTIONS = {
    **{name: f"--{name}" for name in _ALIKE},
    **dict.fromkeys(("initial_pitch", "initial_roll", "target_offset"), "--initial"),
    **dict.fromkeys(("tip_noise", "tip_covariance", "tip_noise_bound"), "--noise-mm"),
    **dict.fromkeys(("needle_diameter", "needle_width"), "--diameter-mm"),
    **dict.fromkeys(("pre_bend", "pre_bend_lean", "tip_lean"), "--pre-bend-deg"),
    **dict.fromkeys(("curvature", "max_curvature"), "--curvature"),
    "torsion_play": "--play-deg",
    "torsion_lag": "--lag-mm",
    "measurement_std": "--noise-mm",
    "preset": "--controller",
    "depth": "--depth-mm",
    "target_point": "--target",
}

# Seven processes share the cores: drives and driver wait for each other longer than by default [s].
GRAPH_WATCHDOG = 0.5

# Parameters of the recorder that leave something out of the bag.
_CHOICES = ("topics", "regex", "exclude_regex", "snapshot_seconds")


def merge(*layers: Parameters) -> Parameters:
    """Return the layers as one; later ones win, parameter by parameter."""
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
    """Return what the command line sets in the nodes that the run needs.

    Parameters
    ----------
    options : SimulateOptions
        The command line.
    bag : Path
        The bag's folder.
    command : str, optional
        What repeats the run; `simulate` with these options by default.
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
    driver: dict[str, Any] = {
        "link": "slcan",
        "channel": str(can_adapter()),
    }
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
        # The sensor's own data sheet: the controllers know how far off a tip can be.
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
    parameters = merge(parameters, needle)
    return {node: parameters[node] for node in nodes_of(options)}


def _obstacles(path: Path) -> list[float]:
    """Return a file's obstacles as plane_controller's parameter has them."""
    # It brings compiled code along: half a second that only runs with obstacles pay for.
    from needle_controller.planning.obstacles import read_obstacles  # noqa: PLC0415

    return [float(value) for value in read_obstacles(path).table.ravel()]


def can_adapter() -> Path:
    """Return where this process' emulated CAN adapter is plugged in; gone when it has ended."""
    return Path(tempfile.gettempdir()) / f"needle_can_{os.getpid()}"


def refuse_reserved(path: Path, given: Parameters, options: SimulateOptions) -> None:
    """Refuse a parameter file that contradicts the command line.

    Raises
    ------
    UserError
        If the file sets what an option sets, or what the recorder leaves out.
    """
    reserved = command_line_parameters(options, Path())
    for node, values in given.items():
        for name in values:
            if name in reserved[node]:
                option = OPTIONS.get(name)
                hint = f"use {option}" if option else "simulate sets it itself"
                raise UserError(f"{path}: {node}: {name} does not go into the file, {hint}")
    chosen = [name for name in given.get("recorder", {}) if name in _CHOICES]
    if chosen:
        why = "simulate waits for a recorder of everything and reports the whole run"
        raise UserError(f"{path}: recorder: {chosen[0]} does not go into the file: {why}")


def run_info(options: SimulateOptions) -> dict[str, Any]:
    """Return what the bag says about how it was made."""
    told = dataclasses.asdict(options)
    for name in ("bag", "params", "json"):
        del told[name]
    return {**told, "obstacles": None if options.obstacles is None else options.obstacles.name}


def write_parameters(path: Path, parameters: Parameters) -> None:
    """Write a ROS parameter file."""
    document = {node: {"ros__parameters": values} for node, values in parameters.items()}
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
