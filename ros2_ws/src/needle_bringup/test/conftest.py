"""Shared fixtures: a made-up run, and compiled code that is loaded before the tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from made_up_run import make_run
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import make_components
from needle_core.runners.virtual import VirtualRunner

__all__ = ["make_run"]


@pytest.fixture(scope="session")
def compiled() -> None:
    """Load the controller's compiled code."""
    parameters = command_line_parameters(parse(["--level", "tip"]), Path())
    VirtualRunner(make_components(parameters)).run(3.0)
