"""Command lines of `simulate` and `console`: meaning and rejections."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from pathlib import Path

import pytest

from needle_bringup.simulation.console import parse_console, rig_parameters
from needle_bringup.simulation.simulate_options import (
    CONTROLLERS,
    SimulateOptions,
    command_of,
    parse,
)
from needle_bringup.simulation.virtual_run import own_component
from needle_controller.presets.steering_settings import PRESETS
from needle_core.errors import UserError

# Invalid arguments, and the part that the error names; `number` checks the bounds.
REFUSED = (
    ("--controller worst", "worst"),
    ("--initial -3,2", "X_MM,PITCH_DEG,ROLL_DEG"),
    ("--target 3,2", "X_MM,Y_MM,Z_MM"),
    ("--level camera --noise-mm 0", "--noise-mm applies to --level tip"),
    ("--level tip --drives cia402", "--drives applies to --level drive"),
    ("--planner mine", "--planner applies to --target"),
    ("--obstacles x", "--obstacles applies to --target"),
    ("--target 0,0,90 --obstacles /no", "--obstacles /no: no such file"),
    ("--depth-mm 150.1", "--depth-mm"),
    ("--diameter-mm 5", "--diameter-mm = 5 mm is outside"),
    ("--real-time-factor 2 --graph", "--real-time-factor 2 excludes --graph"),
    ("--component probe", "'probe' is not MODULE:NAME"),
    ("--component a:B --graph", "excludes --graph"),
    ("--bag /tmp", "exists already"),
    ("--params /", "/: a folder, not a file"),
)
PROBE = """
from needle_core.component import Component

class Probe(Component):
    name = "probe"

class Other:
    pass
"""


def test_invalid_options_are_named() -> None:
    for command_line, named in REFUSED:
        with pytest.raises(UserError) as caught:
            parse(command_line.split())
        assert named in str(caught.value), command_line
    with pytest.raises(UserError, match="--port"):
        parse_console(["--port", "65535"])


def test_every_preset_of_the_controller_is_an_option() -> None:
    assert sorted(CONTROLLERS) == sorted(PRESETS)


def test_the_defaults_of_the_command_line_are_those_of_the_options() -> None:
    assert parse([]) == SimulateOptions()
    assert parse(["--level", "tip"]) == SimulateOptions(level="tip", noise_mm=1.0)
    assert parse(["--target", "-8,5,90"]).depth_mm == 150.0


def test_the_recorded_command_repeats_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a file.yaml").touch()
    for line in (
        "",
        "--level tip --noise-mm 0 --controller open_loop --initial=-1.5,-4,30 --depth-mm 80.25",
        "--target=-8,5,90 --curvature 4 --obstacles 'a file.yaml' --planner mine --graph",
        "--level drive --real-time-factor 1 --params 'a file.yaml' --bag new --json out.json",
        "--component my_probe:Probe --component other:One",
    ):
        options = parse(shlex.split(line))
        program, *argv = shlex.split(command_of(options))
        assert program == "scripts/simulate"
        assert parse(argv) == dataclasses.replace(options, bag=None, json=None), line


def test_the_console_has_the_rig_of_simulate_with_continuous_insertion() -> None:
    command_line = "--level tip --initial -5,1,0 --noise-mm 0.5"
    rig = parse_console(command_line.split()).rig
    assert rig == parse([*command_line.split(), "--insertion=continuous", "--real-time-factor=1"])
    assert parse_console(["--insertion=stepwise"]).rig.insertion == "stepwise"
    assert rig_parameters(parse_console([]))["sim_rig"]["camera_rate"] == 10.0


def test_user_components_are_found_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "probe_of_a_user"
    monkeypatch.delitem(sys.modules, module, raising=False)
    (tmp_path / f"{module}.py").write_text(PROBE)
    monkeypatch.chdir(tmp_path)
    assert own_component(f"{module}:Probe").name == "probe"
    for name, cause in (
        (f"{module}:Missing", "has no attribute 'Missing'"),
        (f"{module}:Other", "makes a Other, not a Component"),
        ("no_such_module:X", "--component no_such_module:X: No module named"),
    ):
        with pytest.raises(UserError, match=cause):
            own_component(name)
