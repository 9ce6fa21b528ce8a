from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from needle_bringup.studies.study_controllers import CURVATURE, STEP_LENGTH, controller_factory
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.beliefs import Belief
from needle_sim.studies.disturbances import Disturbances
from needle_sim.studies.figures_of_merit import Outcomes, figures
from needle_sim.studies.start_grids import GRIDS, StartBounds
from needle_sim.studies.study import StudySettings, run_study

STARTS = GRIDS["random"](StartBounds(0.003, np.deg2rad(10.0), np.deg2rad(30.0)), 1, 4)[:60]
TROUBLE = Disturbances(
    noise=0.001,
    outliers=0.1,
    dropped=0.2,
    delay=2,
    curvature_scale=1.1,
    curvature_patches=0.2,
    play=0.2,
    lag_length=0.004,
    slip=0.02,
    bump=0.002,
)


def settings(**changes: Any) -> StudySettings:
    base = StudySettings(CURVATURE, 0.120, STEP_LENGTH, Disturbances(), seed=1)
    return dataclasses.replace(base, **changes)


def values(outcomes: Outcomes) -> FloatArray:
    return np.column_stack([outcomes.x_last, outcomes.settled, outcomes.rotation])


class Watching:
    """Does not steer; keeps what it is told."""

    def __init__(self) -> None:
        self.lengths: list[float] = []
        self.tips: list[FloatArray] = []
        self.ages: list[float] = []

    def start(self, tips: FloatArray) -> FloatArray:
        return np.zeros(len(tips))

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        self.lengths.append(float(d_insertion))
        self.tips.append(tips)
        self.ages.append(float(age))
        return np.zeros(len(tips))

    def belief(self) -> Belief | None:
        return None


def watched(needle: FloatArray, **changes: Any) -> tuple[Watching, Outcomes]:
    watching = Watching()
    return watching, run_study(needle, lambda: watching, settings(**changes))


def test_not_steered_the_needle_ends_where_its_arc_takes_it() -> None:
    # The arc in closed form: x = x0 + sin(pitch) sin(kl)/k + cos(pitch) sin(roll) (1 - cos(kl))/k.
    start = np.array([[-0.003, np.deg2rad(2.0), np.deg2rad(15.0)]])
    bend = CURVATURE * 0.120
    _, pitch, roll = start[0]
    along = np.sin(bend) / CURVATURE
    across = (1.0 - np.cos(bend)) / CURVATURE
    expected = -0.003 + np.sin(pitch) * along + np.cos(pitch) * np.sin(roll) * across
    assert expected == pytest.approx(0.01462, abs=5e-6)
    found = run_study(start, controller_factory("open_loop", 0.001), settings())
    assert found.x_end[0] == pytest.approx(expected, abs=1e-9)
    assert found.rotation[0] == 0.0
    assert found.x_start[0] == -0.003


@pytest.mark.parametrize("name", ["paper", "best"])
def test_outcomes_follow_the_seed_and_not_the_chunks(name: str) -> None:
    factory = controller_factory(name, 0.001)
    disturbed = settings(disturbances=TROUBLE, depth=0.030)
    whole = values(run_study(STARTS, factory, disturbed))
    np.testing.assert_array_equal(values(run_study(STARTS, factory, disturbed)), whole)
    # how a sum is vectorised may depend on the number of needles: the last digits only
    np.testing.assert_allclose(
        values(run_study(STARTS, factory, disturbed, chunk=7)), whole, atol=1e-9
    )
    other = values(run_study(STARTS, factory, dataclasses.replace(disturbed, seed=2)))
    assert not np.any(other[:, 0] == whole[:, 0])


def test_disturbances_act_on_the_plant() -> None:
    start = np.array([[0.0, 0.0, np.deg2rad(90.0)]])
    factory = controller_factory("open_loop", 0.001)
    # pure insertion out of the plane: x = (1 - cos(kl))/k with the plant's own curvature
    disturbed = settings(disturbances=Disturbances(curvature_scale=0.8))
    curvature = 0.8 * CURVATURE
    found = run_study(start, factory, disturbed)
    assert found.x_end[0] == pytest.approx((1.0 - np.cos(0.12 * curvature)) / curvature, abs=1e-9)
    patched = run_study(start, factory, settings(disturbances=Disturbances(curvature_patches=0.2)))
    low, high = ((1.0 - np.cos(0.12 * k)) / k for k in (0.8 * CURVATURE, 1.2 * CURVATURE))
    assert low < patched.x_end[0] < high


def test_the_last_step_ends_at_the_depth() -> None:
    watching, found = watched(STARTS[:1], depth=0.0105)
    np.testing.assert_allclose(watching.lengths, [0.001] * 10 + [0.0005])
    assert found.x_last.shape == (1, 11)


@pytest.mark.parametrize("slip", [0.05, -0.05])
def test_with_slip_the_needle_goes_in_less_than_the_stage_says(slip: float) -> None:
    # Within the plane, rolled out of it by 90 deg: x = (1 - cos(k l)) / k, l the needle's own.
    start = np.array([[0.0, 0.0, np.deg2rad(90.0)]])
    watching, found = watched(start, disturbances=Disturbances(slip=slip))
    bend = CURVATURE * 0.120 / (1.0 + slip)
    assert found.x_end[0] == pytest.approx((1.0 - np.cos(bend)) / CURVATURE, abs=1e-9)
    assert watching.tips[-1][0, 2] == pytest.approx(np.sin(bend) / CURVATURE, abs=1e-9)
    assert np.sum(watching.lengths) == pytest.approx(0.120)


def test_a_bump_moves_the_needle_once_at_half_the_depth() -> None:
    still, calm = watched(STARTS, depth=0.030)
    watching, found = watched(STARTS, depth=0.030, disturbances=Disturbances(bump=0.002))
    moved = np.array(watching.tips) - np.array(still.tips)
    np.testing.assert_allclose(moved[:14], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(moved[14:], axis=-1), 0.002)
    np.testing.assert_allclose(moved[14:], np.broadcast_to(moved[14], moved[14:].shape))
    # the plane stays where it is
    np.testing.assert_allclose(found.x_last - calm.x_last, moved[10:, :, 0].T, atol=1e-12)


def test_tips_that_are_late_untold_come_as_if_they_were_new() -> None:
    prompt, _ = watched(STARTS[:3], depth=0.010)
    late, _ = watched(STARTS[:3], depth=0.010, disturbances=Disturbances(untold_delay=3))
    assert np.all(np.isnan(late.tips[:3]))
    np.testing.assert_array_equal(late.tips[3:], prompt.tips[:-3])
    assert late.ages == [0.0] * 10
    both, _ = watched(STARTS[:3], depth=0.010, disturbances=Disturbances(delay=2, untold_delay=1))
    np.testing.assert_array_equal(both.tips[3:], prompt.tips[:-3])
    np.testing.assert_allclose(both.ages[3:], 0.002)


def test_what_a_controller_says_is_compared_with_the_truth_of_that_step() -> None:
    class Knowing(Watching):
        """Knows the tip of a needle that lies in a plane at its roll of 0, and says so."""

        def belief(self) -> Belief | None:
            x = self.tips[-1][:, 0]
            some = np.full_like(x, 1e-9)
            return Belief(x, some, np.zeros_like(x), some, np.array([True, False, False, False]))

    level = np.zeros((4, 3))
    level[:, 0] = [0.0, 0.001, 0.002, 0.003]
    found = run_study(level, Knowing, settings(depth=0.030))
    np.testing.assert_array_equal(found.inside_2_sigma, 1.0)
    assert figures(found)["doubtful_at_end"] == 0.25
    pitched = level + np.array([0.0, 0.1, 0.0])
    # x is known, the pitch is not
    np.testing.assert_array_equal(
        run_study(pitched, Knowing, settings(depth=0.030)).inside_3_sigma, 0.5
    )


def test_paper_steers_most_needles_to_the_plane() -> None:
    starts = GRIDS["endpoint"](StartBounds(0.003, np.deg2rad(10.0), np.deg2rad(30.0)), 1, 1)
    noisy = settings(disturbances=Disturbances(noise=0.001), seed=7)
    found = run_study(starts, controller_factory("paper", 0.001), noisy)
    # of 10,000 runs it is >= 0.955; three standard errors of 1,000
    assert np.mean(found.converged_at_end) >= 0.935
    assert np.mean(found.diverged) < 0.02


@pytest.mark.parametrize("flips", [0, 3])
def test_best_steers_every_needle_to_the_plane(flips: int) -> None:
    depths = np.linspace(0.0, 0.12, flips + 2)[1:-1].tolist()
    noisy = settings(disturbances=Disturbances(noise=0.001), seed=7)
    found = run_study(STARTS, controller_factory("best", 0.001, depths), noisy)
    assert np.mean(found.converged_at_end) >= 0.98


def test_the_readme_s_own_law_runs_as_it_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text("utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    share = float(capsys.readouterr().out)
    assert f"It prints {share:.3f}" in text
