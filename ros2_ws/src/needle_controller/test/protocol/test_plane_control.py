"""One needle's estimator and law by preset: what the node runs for each tip."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import offset_plane
from needle_controller.presets.steering_settings import PRESETS, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl
from needle_core.errors import UserError
from needle_sim.needle.plant import NeedlePlant, initial_pose

OFFSET = 0.003
STEP = SteeringSettings.step_length
NOISE = 0.0005


@dataclasses.dataclass
class Insertion:
    """An exact needle steered by a PlaneControl, one step at a time."""

    control: PlaneControl
    plant: NeedlePlant
    rng: np.random.Generator
    rotation: float = 0.0
    steps: int = 0

    def run(self, steps: int) -> Array:
        """Steer on; return the true x in the plane after each step."""
        track = []
        for _ in range(steps):
            tip = self.plant.T_rig_tip[:3, 3] + self.rng.uniform(-NOISE, NOISE, 3)
            joints = JointSample(self.steps, self.steps * STEP, self.rotation)
            update = self.control.update(tip, joints)
            turn = float(update.command.rotation_rate) * STEP
            self.plant.advance(STEP, turn)
            self.rotation += turn
            self.steps += 1
            track.append(float(self.plant.T_rig_tip[0, 3]) - OFFSET)
        return np.array(track)

    @property
    def roll(self) -> float:
        """The true roll [rad]."""
        rotation = self.plant.T_rig_tip[:3, :3]
        return float(np.arctan2(-rotation[0, 1], rotation[0, 0]))


def insertion(settings: SteeringSettings, seed: int = 5) -> Insertion:
    """A needle that starts as [KC09] figure 3's."""
    plant = NeedlePlant(initial_pose(np.deg2rad(2.0), np.deg2rad(15.0)), curvature=1 / 0.122)
    control = PlaneControl(settings, offset_plane(OFFSET))
    return Insertion(control, plant, np.random.default_rng(seed))


def settings_of(preset: str) -> SteeringSettings:
    """A preset with the noise of these tests."""
    return SteeringSettings(
        preset=preset,
        tip_noise="bounded",
        tip_noise_bound=NOISE,
        measurement_std=NOISE / math.sqrt(3.0),
    )


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "open_loop"])
def test_a_preset_steers_into_the_plane_and_stays(preset: str) -> None:
    track = insertion(settings_of(preset)).run(120)
    assert np.all(np.abs(track[-20:]) < 1e-3)


@pytest.mark.parametrize("preset", ["best"])
@pytest.mark.parametrize("turned", [2.0, -3.0, 14.0])
def test_the_base_may_be_turned_from_the_last_run(preset: str, turned: float) -> None:
    needle = insertion(settings_of(preset))
    needle.rotation = turned
    start = initial_pose(np.deg2rad(2.0), np.deg2rad(15.0) + turned)
    needle.plant = NeedlePlant(start, curvature=1 / 0.122)
    assert np.all(np.abs(needle.run(120)[-20:]) < 1e-3)


def test_best_takes_tips_with_normal_noise_too() -> None:
    settings = dataclasses.replace(settings_of("best"), tip_noise="normal")
    track = insertion(settings).run(120)
    assert np.all(np.abs(track[-20:]) < 1e-3)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        *itertools.product(("best", "paper", "open_loop"), repeat=2),
    ],
)
def test_a_change_of_preset_keeps_the_estimated_pose(before: str, after: str) -> None:
    needle = insertion(settings_of(before))
    needle.run(40)
    estimator = needle.control._estimator
    pose = estimator.estimate()
    needle.control.configure(settings_of(after))
    kept = needle.control._estimator.estimate()
    np.testing.assert_allclose(kept.position, pose.position, atol=1e-9)
    assert kept.linearized[1] == pytest.approx(pose.linearized[1], abs=1e-3)
    if after != "best":
        # s, since it cannot say on which side of +-90 deg the roll is; the mean of a new bank of
        # hypotheses lies between them.
        assert kept.linearized[2] == pytest.approx(pose.linearized[2], abs=1.0)


def test_best_goes_on_after_a_change_in_the_middle_of_a_run() -> None:
    needle = insertion(settings_of("paper"))
    needle.run(40)
    needle.control.configure(settings_of("best"))
    assert np.all(np.abs(needle.run(80)[-20:]) < 1e-3)


@pytest.mark.parametrize("preset", ["best"])
def test_a_flip_turns_the_bevel_over_and_holds_the_plane(preset: str) -> None:
    settings = dataclasses.replace(settings_of(preset), flip_depths=(0.07,))
    needle = insertion(settings)
    needle.run(69)
    assert np.cos(needle.roll) > 0.25
    track = needle.run(51)
    assert np.cos(needle.roll) < -0.25
    assert np.all(np.abs(track) < 1e-3)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"preset": "paper", "flip_depths": (0.05,)}, "preset paper cannot steer"),
        ({"flip_depths": (0.05, 0.05)}, "flip 2"),
        ({"flip_depths": (0.2,)}, "flip 1 = 0.2 m is outside"),
        ({"target_offset": 0.05}, "cannot be reached"),
        ({"curvature": 0.0}, "curvature = 0"),
        ({"tip_noise": "pink"}, "'pink'"),
        ({"tip_noise_bound": 0.0}, "tip_noise_bound"),
        ({"state_weights": tuple(range(9))}, "state_weights.*three numbers"),
        ({"process_noise": (1.0, 1.0)}, "process_noise.*three numbers"),
        ({"tip_covariance": "none"}, "'none'"),
    ],
)
def test_a_bad_whole_is_refused_with_what_and_why(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        SteeringSettings(**changes)


def test_the_base_is_kept_within_its_winding_and_unwinds() -> None:
    settings = dataclasses.replace(settings_of("best"), max_winding=7.0)
    needle = insertion(settings)
    needle.rotation = 17.0
    start = initial_pose(np.deg2rad(2.0), np.deg2rad(15.0) + 17.0)
    needle.plant = NeedlePlant(start, curvature=1 / 0.122)
    needle.run(60)
    assert abs(needle.rotation) < 7.0
    assert np.all(np.abs(needle.run(60)[-20:]) < 1e-3)
