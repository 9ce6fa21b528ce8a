"""Examples in docs/examples that the tests of the pages do not execute."""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from needle_bringup.simulation.rig_configuration import (
    NODES,
    command_line_parameters,
    contradictions,
    merge,
    nodes_of,
    refuse_reserved,
)
from needle_bringup.simulation.simulate_options import parse
from needle_controller.observers.estimator import Estimate, pose_estimate
from needle_controller.planning.path_planner import entry_state
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_core.settings.parameter_files import read_parameters
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.sim_rig_parameters import SimRigParameters
from needle_tracker.tracker_parameters import StereoTrackerParameters

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
SETTINGS = SteeringSettings(**PAPER_NOISE)
NOISE, STEP = SETTINGS.tip_noise_bound, SETTINGS.step_length


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that gives the class of a module of the example package."""
    monkeypatch.syspath_prepend(EXAMPLES / "own_controllers")

    def of(module: str, name: str) -> Any:
        return getattr(importlib.import_module(f"own_controllers.{module}"), name)

    return of


def followed(
    filter_: Any, start: int, rng: np.random.Generator
) -> tuple[Estimate, npt.NDArray[np.float64]]:
    """Insert a needle by 60 mm with turns; return the estimate and its true pose."""
    pose = initial_pose(0.1 * start - 0.15, 0.2 * start - 0.3)
    plant = NeedlePlant(pose, curvature=SETTINGS.curvature)
    filter_.reset(np.array(plant.T_rig_tip[:3, 3]), np.zeros(2))
    for k in range(60):
        turn = (0.2, -0.3, 0.5, 0.0)[start] if k % 20 < 10 else 0.0
        plant.advance(STEP, turn)
        tip = plant.T_rig_tip[:3, 3] + rng.uniform(-NOISE, NOISE, 3)
        filter_.advance(STEP, turn)
        filter_.correct(np.full(3, np.nan) if k == 30 else tip, None, 0.0)
    return filter_.estimate(), np.array(plant.T_rig_tip)


def test_the_particle_filter_estimates_needles_and_its_accuracy(own: Any) -> None:
    made_by, rng = own("particle_filter", "ParticleFilter"), np.random.default_rng(2)
    for start in range(4):
        filter_ = made_by(SETTINGS, np.eye(3), np.zeros(3), np.random.default_rng(start))
        known, true = followed(filter_, start, rng)
        assert np.linalg.norm(known.position - true[:3, 3]) < NOISE
        assert np.arccos(known.rotation[:, 2] @ true[:3, 2]) < math.radians(4.0)
        assert 0.05 * NOISE < np.sqrt(known.covariance[0, 0]) < 0.6 * NOISE


def test_pursuit_bends_to_the_plane_from_either_side(own: Any) -> None:
    law = own("pursuit", "Pursuit")(SETTINGS)
    # Above the plane, and below it, with the bevel towards -x and then +x: there already.
    for x, side in ((0.003, -1.0), (-0.003, 1.0)):
        roll = side * math.pi / 2.0
        c, s = math.cos(roll), math.sin(roll)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        place = np.array([x, 0.0, 0.0])
        right = law.to_plane(pose_estimate(place, turn, 8.0, np.eye(6)), 0.0)
        assert float(right) == pytest.approx(0.0, abs=1e-6)
        wrong = law.to_plane(pose_estimate(-place, turn, 8.0, np.eye(6)), 0.0)
        assert abs(float(wrong)) == pytest.approx(math.pi / STEP)


def test_sidestep_leads_around_an_obstacle(own: Any) -> None:
    planner = own("sidestep", "Sidestep")(SETTINGS)
    tip, target = entry_state(SETTINGS.curvature), np.array([0.0, 0.0, 0.1])
    free = np.array([[0.05, 0.0, 0.05, 0.05, 0.0, 0.05, 0.003]])
    np.testing.assert_array_equal(planner.via_points(tip, target, free), [target])
    for y in (0.002, 0.0):
        sphere = np.array([[0.0, y, 0.05, 0.0, y, 0.05, 0.003]])
        via, last = planner.via_points(tip, target, sphere)
        assert np.linalg.norm(via - sphere[0, :3]) == pytest.approx(0.005)
        np.testing.assert_array_equal(last, target)


@pytest.mark.parametrize(
    ("name", "warns"),
    [("thin_needle", False), ("unknown_tissue", True), ("bare_steel", False), ("glare", False)],
)
def test_simulate_accepts_the_parameter_files(name: str, warns: bool) -> None:
    path = EXAMPLES / "params" / f"{name}.yaml"
    given, options = read_parameters(path, NODES), parse([])
    refuse_reserved(path, given, options)
    SimRigParameters(**given["sim_rig"])
    StereoTrackerParameters(**given.get("stereo_tracker", {}))
    SteeringSettings(**given.get("plane_controller", {}))
    all_of_it = merge(command_line_parameters(options, Path()), given)
    assert bool(contradictions(all_of_it, nodes_of(options))) == warns


def test_every_parameter_file_is_tested() -> None:
    page = (EXAMPLES / "README.md").read_text("utf-8")
    for path in (EXAMPLES / "params").iterdir():
        assert f"`{path.name}`" in page


@pytest.mark.parametrize("notebook", sorted(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.name)
def test_a_notebook_runs(notebook: Path) -> None:
    for name in ("pandas", "nbclient", "ipykernel"):
        pytest.importorskip(name, reason="the notebooks' lock is not installed: docs/viewers.md")
    # In a separate process: running it leaves an event loop behind.
    run = "import sys; from nbclient.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", run, "--timeout=60", str(notebook)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
