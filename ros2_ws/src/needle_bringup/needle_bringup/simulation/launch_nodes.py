"""Nodes of the launch files and their parameters, from launch arguments."""

from __future__ import annotations

import difflib
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from needle_bags.format.bag_writer import refuse_existing_bag
from needle_bringup.simulation.rig_configuration import PACKAGES, command_line_parameters, merge
from needle_bringup.simulation.simulate_options import existing_file, parse
from needle_core.errors import UserError
from needle_core.settings.parameter_files import Parameters, read_parameters

LAUNCHED_PACKAGES = {
    **PACKAGES,
    "tracked_tip": "needle_tracker",
    "player": "needle_bags",
    "live_view": "needle_bags",
}
"""Package of each node in a launch file."""
# Topics of the live view that the player publishes only under /replay.
_NOT_FOR_RIGS = ("target_plane", "target_point")

# Parameter that a file must not set -> its launch argument.
_RESERVED_BY_SIMULATION = {
    "level": "level",
    "seed": "seed",
    "preset": "controller",
    "bag": "bag",
    "pty": "can",
    "channel": "can",
}
_CLOSE = 0.84  # similarity of a misspelt name; that of ros_namespace is lower
_RESERVED_BY_RIG = {
    "calibration_file": "calibration",
    "registration_file": "registration",
    "bag": "bag",
}


def refuse_misspelt(given: Iterable[str], declared: Sequence[str]) -> None:
    """Reject launch arguments that resemble a declared one; launch accepts any name.

    Other names may be arguments of an including launch file.

    Parameters
    ----------
    given : iterable of str
        Names of all launch arguments.
    declared : sequence of str
        Names declared by the launch file.

    Raises
    ------
    UserError
        If an argument is misspelt; the message names it and the similar one.
    """
    for name in given:
        meant = difflib.get_close_matches(name.lower(), declared, n=1, cutoff=_CLOSE)
        if name not in declared and meant:
            raise UserError(f"unknown argument {name}:=, did you mean {meant[0]}:=?")


def simulated_nodes(arguments: Mapping[str, str]) -> Parameters:
    """Return the nodes of simulation.launch.py, which are those of `simulate --graph`.

    Parameters
    ----------
    arguments : mapping
        Launch argument -> text: level, seed, controller, simulated_operator, bag,
        can, params and namespace.

    Returns
    -------
    dict
        Node -> parameter -> value.

    Raises
    ------
    UserError
        If an argument is invalid, a file is missing, or the bag exists.
    """
    argv = ["--graph"]
    for name in ("level", "seed", "controller"):
        argv += [f"--{name}", arguments[name]]
    bag = _new_bag(arguments["bag"])
    given = [f"{name}:={value}" for name, value in arguments.items() if value and name != "bag"]
    command = shlex.join(["ros2", "launch", "needle_bringup", "simulation.launch.py", *given])
    parameters = command_line_parameters(parse(argv), bag or Path(), f"{command} bag:=NEW")
    for name, parameter in (("drive_emulator", "pty"), ("device_driver", "channel")):
        if name in parameters:
            parameters[name][parameter] = arguments["can"]
    if arguments["simulated_operator"] == "false":
        del parameters["simulated_operator"]
    if bag is None:
        del parameters["recorder"]
        parameters.get("simulated_operator", {}).pop("wait_for_recorder", None)
    return _with_file(parameters, arguments, _RESERVED_BY_SIMULATION)


def nodes_alongside_rig(arguments: Mapping[str, str]) -> Parameters:
    """Return the nodes of rig.launch.py.

    Parameters
    ----------
    arguments : mapping
        Launch argument -> text: calibration, registration, drives, bag, params and namespace.

    Returns
    -------
    dict
        Node -> parameter -> value.

    Raises
    ------
    UserError
        If a file is missing or invalid, or the bag exists.
    """
    name = "registration" if arguments["registration"] else "calibration"
    file = str(existing_file(f"{name}:=", arguments[name]).absolute())
    bag = _new_bag(arguments["bag"])
    parameters: Parameters = {"plane_controller": {}}
    if arguments["registration"]:
        parameters["tracked_tip"] = {"registration_file": file}
    else:
        # A best-effort subscription matches cameras of either reliability.
        parameters["stereo_tracker"] = {"calibration_file": file, "reliable_images": False}
    if bag is not None:
        parameters["recorder"] = {"bag": str(bag), "run_info": json.dumps(dict(arguments))}
    if arguments["drives"]:
        parameters.update(_read("drives", arguments, ["device_driver"]))
    return _with_file(parameters, arguments, _RESERVED_BY_RIG)


def replayed_nodes(arguments: Mapping[str, str]) -> Parameters:
    """Return the nodes of replay.launch.py.

    Parameters
    ----------
    arguments : mapping
        Launch argument -> text: bag.

    Returns
    -------
    dict
        Node -> parameter -> value; no parameters are set.

    Raises
    ------
    UserError
        If no bag is given, or it does not exist.
    """
    if not arguments["bag"]:
        raise UserError("bag:= is missing: the folder of the bag to play")
    if not (Path(arguments["bag"]).expanduser() / "metadata.yaml").is_file():
        raise UserError(f"bag:={arguments['bag']}: no bag there (no metadata.yaml)")
    return {"player": {}, "live_view": {}}


def replay_arguments(arguments: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the command line arguments of the nodes of replay.launch.py.

    Parameters
    ----------
    arguments : mapping
        Launch argument -> text: bag, rate, start, loop and namespace.
    """
    player = [str(Path(arguments["bag"]).expanduser().absolute())]
    for name in ("rate", "start"):
        player += [f"--{name}", arguments[name]]
    if arguments["loop"] == "true":
        player.append("--loop")
    played = "/".join(["/replay", *filter(None, arguments["namespace"].split("/"))])
    remapped = (["-r", f"{name}:={played}/{name}"] for name in _NOT_FOR_RIGS)
    return {"player": player, "live_view": ["--ros-args", *(w for ws in remapped for w in ws)]}


def _with_file(
    parameters: Parameters, arguments: Mapping[str, str], reserved: Mapping[str, str]
) -> Parameters:
    """Return the parameters, overridden by those in a parameter file."""
    if not arguments["params"]:
        return parameters
    given = _read("params", arguments, list(parameters))
    for node, values in given.items():
        for name in reserved.keys() & values.keys():
            where = f"params:={arguments['params']}: {node}"
            raise UserError(f"{where}: {name} is set by {reserved[name]}:=")
    return merge(parameters, given)


def _read(argument: str, arguments: Mapping[str, str], nodes: Sequence[str]) -> Parameters:
    file = existing_file(f"{argument}:=", arguments[argument])
    return read_parameters(file, nodes, arguments.get("namespace", ""))


def _new_bag(text: str) -> Path | None:
    if not text:
        return None
    bag = Path(text).expanduser().absolute()
    refuse_existing_bag(bag)
    return bag
