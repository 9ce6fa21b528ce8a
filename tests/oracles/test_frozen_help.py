"""`--help` of every command: the frozen text, but for what has a reason."""

from __future__ import annotations

from pathlib import Path

from reference.command_pages import help_of_module, help_of_script, scripts
from reference.rig_nodes import executables

HELP = Path(__file__).resolve().parent / "help"
CHANGED = {
    "identify_curvature": "--forecast-mm says where the tip will be",
    "recover": "a bag's files are told by their names alone",
    "monte_carlo": "tissue that pushes, a roll that wanders, a bias that walks and more go wrong",
    "rerun": "--viewers takes a bag through live_view and openigtlink",
    "scripts_console": "the rig is in one process, cameras and tracker in a second one",
    "scripts_dask": "what it installs is an extra of pyproject.toml",
    "scripts_docs": "Sphinx goes into .venv",
    "scripts_soak": "the page on clusters is several_computers.md",
    "scripts_setup": "it takes the extras to be installed",
    "scripts_train_needle_map": "what draws its patches is in needle_bringup",
    "calibrate_stereo": "no picture of what the corners miss by: what is wrong is said in words",
    "scripts_verify": "interrupts and the open loop are asked of other tests",
    "track_images": "one tracker in place of two: other rules, no searched region",
    "scripts_simulate": "the run is in one process: --graph runs the nodes, --component adds one",
}
"""Commands whose text differs from the frozen one, and why."""


def todays_texts() -> dict[str, str]:
    texts = {name: help_of_module(module, name) for _, name, module in executables("command")}
    texts["player"] = help_of_module("needle_bags.ros.player", "player")
    return texts | {f"scripts_{name}": help_of_script(name) for name in scripts()}


def test_commands_say_what_they_said() -> None:
    frozen = {file.stem: file.read_text("utf-8") for file in HELP.glob("*.txt")}
    today = todays_texts()
    assert today.keys() == frozen.keys()
    assert {name for name in today if today[name] != frozen[name]} == set(CHANGED)
