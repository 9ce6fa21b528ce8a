"""`ros2 run needle_bringup robot_model`: write the rig's URDF, or check one."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence

import numpy as np

from needle_bags.live.live_view import LiveView, LiveViewParameters
from needle_bags.live.rig_model import joint_attributes, rig_urdf
from needle_bringup.simulation.rig_configuration import SHARED, contradictions
from needle_bringup.simulation.simulate_options import existing_file
from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command
from needle_core.commands.options import CommandParser, output_file
from needle_core.files.installed import find_shared_file
from needle_core.settings.parameter_fields import from_values
from needle_core.settings.parameter_files import NODES, Parameters, read_parameters
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_tracker.optics.calibration import load_calibration

_DESCRIPTION = """\
Write the URDF of the rig from its calibration and parameters, for planners and viewers; live_view
publishes the same as robot_description. With --check, compare the joints of an existing URDF with
them; further joints and all shapes may be any.
"""
_EPILOG = """\
examples:
  ros2 run needle_bringup robot_model --calibration rig.yaml --params drives.yaml rig.urdf
  ros2 run needle_bringup robot_model --calibration rig.yaml --params drives.yaml --check mine.urdf

exit codes: 0 written, or no difference; 1 URDF, calibration and parameters differ; 2 invalid or
missing input; 130 interrupted
"""
# Absolute [m or rad] and relative tolerance of a number.
_DISTANCE, _SHARE = 1e-4, 1e-4


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    return run_command(lambda: robot_model(_parser().parse_args(arguments)))


def _parser() -> CommandParser:
    parser = CommandParser("robot_model", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add("urdf", metavar="URDF", help="file to write, or to check")
    add("--check", action="store_true", help="compare the file instead of writing it")
    add("--calibration", metavar="FILE", help="calibration of the cameras (the simulated rig's)")
    add("--params", metavar="FILE", help="parameter file of the rig's nodes (defaults)")
    return parser


def robot_model(options: Namespace) -> int:
    """Write or check the URDF, and print the differences; return the exit code.

    Raises
    ------
    UserError
        If a file is missing or invalid.
    """
    installed = find_shared_file("needle_tracker", "config/calibration.yaml")
    calibration = existing_file("--calibration ", options.calibration or str(installed))
    parameters: Parameters = {}
    if options.params is not None:
        parameters = read_parameters(existing_file("--params ", options.params), NODES)
    settings = _settings(parameters)
    limits = SafetyLimits.of(settings)
    urdf = rig_urdf(load_calibration(calibration), limits, settings.needle_diameter)
    found = contradictions(parameters, tuple(parameters))
    if options.check:
        text = existing_file("", options.urdf).read_text("utf-8", errors="replace")
        found += differences(joint_attributes(urdf), joint_attributes(text))
    else:
        output_file("URDF", options.urdf).write_text(urdf, "utf-8")
    print("\n".join(found) or "URDF, calibration and parameters agree")
    return EXIT_MISSED if found else EXIT_DONE


def _settings(parameters: Parameters) -> LiveViewParameters:
    """Return the parameters of the model, taken from any node that shares them."""
    own = LiveView.name
    values = {
        shared.names[own]: parameters[node][name]
        for shared in SHARED
        if own in shared.names
        for node, name in shared.names.items()
        if name in parameters.get(node, {})
    }
    return from_values(LiveViewParameters, values, own)


def differences(model: Mapping[str, str], given: Mapping[str, str]) -> list[str]:
    """Return a line for each joint attribute that differs from the model's.

    Parameters
    ----------
    model, given : mapping of str to str
        Attributes of the joints of the rig, and of the URDF.
    """
    return [
        f"{name} is {given.get(name, 'missing')}, expected {text}"
        for name, text in model.items()
        if not (name.endswith("effort") or _alike(text, given.get(name, "")))
    ]


def _alike(one: str, other: str) -> bool:
    try:
        wanted, given = (np.array(text.split(), dtype=float) for text in (one, other))
        return wanted.shape == given.shape and np.allclose(wanted, given, _SHARE, _DISTANCE)
    except ValueError:
        return one == other


if __name__ == "__main__":
    sys.exit(main())
