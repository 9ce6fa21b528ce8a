"""The command line of `console`, and the nodes that it starts."""

from __future__ import annotations

import socket

import pytest

from needle_bringup.simulation.console import console, console_parameters
from needle_bringup.simulation.console_options import ConsoleOptions, parse_console
from needle_core.errors import UserError


def test_a_rig_runs_in_real_time_without_a_stand_in_or_a_recorder() -> None:
    parameters = console_parameters(parse_console(["--level", "drive", "--port", "9000"]))
    assert list(parameters) == [
        "sim_rig",
        "drive_emulator",
        "device_driver",
        "stereo_tracker",
        "plane_controller",
        "console",
    ]
    assert parameters["sim_rig"]["camera_rate"] == 10.0
    assert parameters["plane_controller"]["insertion"] == "continuous"
    assert parameters["console"] == {"address": "127.0.0.1", "port": 9000, "hold_port": 9001}
    for values in parameters.values():
        assert "wait_for_recorder" not in values


def test_options_of_the_rig_mean_what_they_mean_for_simulate() -> None:
    words = ["--level", "tip", "--initial", "-5,1,0", "--noise-mm", "0.5", "--insertion=stepwise"]
    rig = parse_console(words).rig
    assert (rig.level, rig.initial_x_mm, rig.noise_mm) == ("tip", -5.0, 0.5)
    assert rig.insertion == "stepwise"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--port", "0"], "--port"),
        (["--port", "65535"], "--port"),
        (["--level", "moon"], "--level"),
        (["--noise-mm", "1"], "--level tip only"),
        (["--bag", "x"], "--bag"),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(words: list[str], complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        parse_console(words)


@pytest.mark.parametrize("which", [0, 1])
def test_a_port_that_is_taken_is_told_before_a_node_starts(which: int) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = int(taken.getsockname()[1])
        options = ConsoleOptions(port - which, parse_console([]).rig)
        with pytest.raises(UserError, match=f"port {port}: "):
            console(options)
