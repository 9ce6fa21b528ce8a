from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_bags.reading.bag_reader import HealthEvent, Run, Series, read_run
from needle_bags.run.run_summary import commanded_rotation, reduced_states, summarize

MakeRun = Callable[..., Path]


def test_summary_of_a_known_run(made_up: Run) -> None:
    summary = summarize(made_up, wall_s=12.5)
    depth = np.arange(100, 121) / 120
    r1 = -0.25 + (-2.75) * (1 + np.cos(np.pi * depth)) / 2
    expected = {
        **{"r1_initial_mm": -3.0, "r1_final_mm": -0.25, "insertion_final_mm": 120.0},
        **{"tip_error_p95_mm": 0.5, "depth_error_p95_mm": 0.3, "steps_per_s": 20.0},
        **{"rotation_total_deg": math.degrees(12.0), "seed": 7, "steps": 120, "wall_s": 12.5},
        "r1_rms_last_20_mm": float(np.sqrt(np.mean(r1**2))),
    }
    assert {key: summary[key] for key in expected} == pytest.approx(expected)
    assert (summary["watchdog_trips"], summary["converged"]) == (3, True)
    # At level drive sim_rig has no status of its own to count unanswered ticks in.
    tick = HealthEvent(0, "sim_rig: watchdogs", 1, "the drives left a tick unanswered (1)")
    well = HealthEvent(1, "stereo_tracker: track", 1, "LOST")
    run = dataclasses.replace(made_up, health=[tick, well])
    assert summarize(run)["watchdog_trips"] == 3 + 1


def test_a_stopped_run_has_not_converged(make_run: MakeRun) -> None:
    summary = summarize(read_run(make_run(steps=110, done=False, bad_tip=60)))
    assert abs(float(str(summary["r1_final_mm"]))) < 1.0
    assert (summary["converged"], summary["reached_depth"]) == (False, False)
    assert summary["reason"] == "no tip for 2 s"
    # A NaN tip spoils no figure.
    assert summary["tip_error_p95_mm"] == pytest.approx(0.5)
    assert summary["tips_not_finite"] == 1


def test_commanded_rotations_start_at_the_measured_one(made_up: Run) -> None:
    commands = made_up.joints.values + np.array([1e-3, 0.25])
    commands = dataclasses.replace(made_up.joints, values=commands)
    insertion, begin, end = commanded_rotation(dataclasses.replace(made_up, commands=commands)).T
    np.testing.assert_allclose(insertion, made_up.joints.values[:, 0])
    np.testing.assert_allclose(end - begin, 0.25)


def test_reduced_states_undo_the_rotation() -> None:
    rng = np.random.default_rng(3)
    angles = rng.uniform(-1.2, 1.2, (50, 3))
    quaternions = Rotation.from_euler("XYZ", angles).as_quat()
    poses = np.hstack([rng.normal(size=(50, 3)), quaternions])
    states = reduced_states(Series(np.arange(50), poses, np.arange(50)), 0.5)
    np.testing.assert_allclose(states[:, 0], poses[:, 0] - 0.5)
    np.testing.assert_allclose(states[:, 1:], angles[:, 1:], atol=1e-12)
