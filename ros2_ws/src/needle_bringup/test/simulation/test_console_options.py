"""The command line of `console`, and the rig that it runs."""

from __future__ import annotations

import socket

import pytest

from needle_bringup.simulation.console import console, rig_parameters
from needle_bringup.simulation.console_options import ConsoleOptions, parse_console
from needle_core.errors import UserError


def test_a_rig_is_steered_without_a_stop_and_seen_as_often_as_a_page_shows_it() -> None:
    parameters = rig_parameters(parse_console(["--level", "drive"]))
    assert parameters["sim_rig"]["camera_rate"] == 10.0
    assert parameters["plane_controller"]["insertion"] == "continuous"


def test_options_of_the_rig_mean_what_they_mean_for_simulate() -> None:
    words = ["--level", "tip", "--initial", "-5,1,0", "--noise-mm", "0.5", "--insertion=stepwise"]
    rig = parse_console(words).rig
    assert (rig.level, rig.initial_x_mm, rig.noise_mm) == ("tip", -5.0, 0.5)
    assert rig.insertion == "stepwise"


def test_a_graph_has_the_same_rig() -> None:
    one, graph = (rig_parameters(parse_console(words)) for words in ([], ["--graph"]))
    del graph["simulated_operator"], one["simulated_operator"], graph["recorder"], one["recorder"]
    assert graph == one


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
def test_a_port_that_is_taken_is_told_in_one_line(which: int) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = int(taken.getsockname()[1])
        options = ConsoleOptions(port - which, parse_console([]).rig)
        with pytest.raises(UserError, match=f"{port}: Address already in use"):
            console(options)
