from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from needle_bags.reading.bag_reader import Run, Series, Status
from needle_bags.run.innovation import (
    Innovations,
    gate_room,
    innovations,
    missed_tips,
    rejected_tips,
)

KAPPA = 8.0
STEPS = 40
OFFSET = 3e-3
MILLIMETRE = 1e-3
MICROSECOND = 1_000
EMPTY = {"truth": 7, "reduced_state": 3, "control_input": 3, "commands": 2, "holds": 2}


def series(values: np.ndarray) -> Series:
    stamps = np.arange(len(values), dtype=np.int64) * 10**9
    return Series(stamps, values, stamps + MICROSECOND)


def needle(turn_per_step: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and orientations of a needle whose base turns, integrated by scipy."""

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        rotation = state[3:].reshape(3, 3)
        spin = np.array([KAPPA, 0.0, turn_per_step / MILLIMETRE])
        return np.concatenate([rotation[:, 2], (rotation @ np.cross(np.eye(3), -spin).T).ravel()])

    depths = np.arange(STEPS + 1) * MILLIMETRE
    start = np.concatenate([np.zeros(3), np.eye(3).ravel()])
    path = solve_ivp(rates, (0.0, depths[-1]), start, t_eval=depths, rtol=1e-10, atol=1e-13).y.T
    return path[:, :3], path[:, 3:].reshape(-1, 3, 3)


def make_run(**changes: Any) -> Run:
    """A run whose estimates are the truth, whose tips have a covariance of 0.1 mm."""
    positions, rotations = needle(0.1)
    joints = np.stack([np.arange(STEPS + 1) * MILLIMETRE, np.arange(STEPS + 1) * 0.1], axis=1)
    quaternions = Rotation.from_matrix(rotations).as_quat()
    exact = np.zeros((STEPS + 1, 36))
    others: dict[str, Any] = {
        **{name: series(np.empty((0, width))) for name, width in EMPTY.items()},
        **{name: [] for name in ("controller_status", "device_status", "results", "health")},
        **{name: {} for name in ("topics", "parameters", "run_info", "versions", "recording")},
        **{"calibration": "", "commit": ""},
    }
    run = Run(
        path=Path("made_up"),
        namespace="/",
        tips=series(positions + np.array([OFFSET, 0.0, 0.0])),
        tip_covariances=series(np.tile(np.eye(3).ravel() * 1e-8, (STEPS + 1, 1))),
        estimate=series(np.hstack([positions, quaternions])),
        estimate_covariances=series(exact),
        joints=series(joints),
        **others,
    )
    run = dataclasses.replace(
        run,
        controller_status=[Status(0, {"target_offset_m": str(OFFSET)})],
        parameters={"/plane_controller": {"curvature": KAPPA, "tip_margin": 4e-3}},
    )
    return dataclasses.replace(run, **changes)


def moved(run: Run, index: int, by: tuple[float, float, float]) -> Run:
    values = run.tips.values.copy()
    values[index] += by
    return dataclasses.replace(run, tips=dataclasses.replace(run.tips, values=values))


def found_in(run: Run) -> Innovations:
    found = innovations(run)
    assert found is not None
    return found


def test_innovation_is_measured_minus_expected() -> None:
    found = found_in(make_run())
    assert len(found.stamps) == STEPS
    np.testing.assert_allclose(found.values, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.sigmas, 1e-4, rtol=1e-9)
    found = found_in(moved(make_run(), 20, (3e-4, -1e-4, 2e-4)))
    np.testing.assert_allclose(found.values[19], [3e-4, -1e-4, 2e-4], atol=1e-9)
    assert found.squared[19] == pytest.approx(9.0 + 1.0 + 4.0, rel=1e-4)
    np.testing.assert_allclose(found.values[20], 0.0, atol=1e-9)
    # A tip that is not finite is none, and without a curvature nothing is expected.
    found = found_in(moved(make_run(), 20, (np.nan, 0.0, 0.0)))
    assert len(found.stamps) == STEPS - 1
    assert np.isfinite(found.squared).all()
    assert innovations(make_run(parameters={})) is None


def test_an_uncertain_heading_widens_the_prediction_across_the_needle() -> None:
    covariance = np.zeros((STEPS + 1, 6, 6))
    covariance[:, 3:, 3:] = np.eye(3) * 0.2**2
    sigmas = found_in(make_run(estimate_covariances=series(covariance.reshape(-1, 36)))).sigmas
    assert sigmas[0, 0] == pytest.approx(np.hypot(1e-4, 0.2 * MILLIMETRE), rel=1e-3)
    assert sigmas[0, 2] == pytest.approx(1e-4, rel=1e-2)


def test_margin_to_the_gate() -> None:
    run = moved(make_run(), 10, (0.0, 0.0, 5e-3))
    room = gate_room(run)
    assert room.margin == 4e-3
    assert np.isnan(room.jump[0])
    assert room.jump[10] == pytest.approx(5e-3, rel=0.05)
    np.testing.assert_allclose(np.delete(room.jump, [0, 10, 11]), 0.0, atol=1e-5)
    assert room.reach.argmax() == 10


def test_rejected_and_missed_tips_are_found() -> None:
    statuses = [
        Status(7 * 10**9 + 2 * MICROSECOND, {"tips_rejected": "1"}),
        Status(8 * 10**9 + 2 * MICROSECOND, {"tips_rejected": "1"}),
        Status(9 * 10**9 + 2 * MICROSECOND, {"tips_rejected": "2"}),
    ]
    nothing = np.tile(np.eye(3).ravel() * 1e-8, (STEPS + 1, 1))
    nothing[[3, 4]] = np.inf
    whole = make_run(controller_status=statuses, tip_covariances=series(nothing))
    used = ~np.isin(whole.estimate.stamps, [6 * 10**9, 7 * 10**9, 9 * 10**9])
    estimate = Series(*(part[used] for part in dataclasses.astuple(whole.estimate)))
    run = dataclasses.replace(whole, estimate=estimate)
    assert rejected_tips(run).tolist() == [7 * 10**9, 9 * 10**9]
    assert missed_tips(run).tolist() == [3 * 10**9, 4 * 10**9]
