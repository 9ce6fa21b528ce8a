"""A point as target: settings, the closed loop, the last step, a target that moves."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import offset_plane
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.next_step import POINT_TOLERANCE, next_step
from needle_controller.protocol.plane_control import PlaneControl
from needle_core.errors import UserError
from needle_sim.needle.plant import NeedlePlant, initial_pose

TARGET = (0.008, -0.006, 0.07)
SETTINGS = SteeringSettings(target_point=TARGET, depth=0.12, **PAPER_NOISE)


STEP_NS = 500_000_000


def steer(
    settings: SteeringSettings,
    *,
    offset: float = 0.0,
    target_at: Callable[[int], Array] | None = None,
    seen_at: Callable[[float], Array] | None = None,
    clocks_apart: float | None = 0.0,
    turns: list[float] | None = None,
) -> tuple[Array, list[bool], float]:
    """Steer an exact needle to the end.

    Returns its tip in `rig`, what it said of its reach, and the time [s]. `target_at` places the
    target before each step, `seen_at` tells where it was at a time, which is stamped by a clock so
    far apart from the tips', or not at all. What the base turns at each step is added to `turns`.
    """
    plant = NeedlePlant(initial_pose(np.deg2rad(3.0), np.deg2rad(20.0)), curvature=1 / 0.122)
    control = PlaneControl(settings, offset_plane(offset))
    rng = np.random.default_rng(5)
    joints = JointSample(0, 0.0, 0.0)
    reachable = []
    for k in itertools.count():
        if target_at is not None:
            control.target_point = target_at(k)
        time = joints.stamp_ns * 1e-9
        if seen_at is not None and clocks_apart is None:
            control.target_point = seen_at(time)
        elif seen_at is not None and clocks_apart is not None:
            control.see_target_point(seen_at(time), time + clocks_apart)
        tip = plant.T_rig_tip[:3, 3] + rng.uniform(-0.0005, 0.0005, 3)
        update = control.update(tip, joints)
        reachable.append(bool(update.reach.reachable))
        step = next_step(k, joints, update.command, settings, slowly=False)
        if step is None:
            return np.array(plant.T_rig_tip[:3, 3]), reachable, time
        length = step.insertion - joints.insertion
        if turns is not None:
            turns.append(abs(step.rotation - joints.rotation))
        plant.advance(length, step.rotation - joints.rotation)
        took_ns = round(STEP_NS * length / settings.step_length)
        joints = JointSample(joints.stamp_ns + took_ns, step.insertion, step.rotation)
    raise AssertionError


@pytest.mark.parametrize("offset", [0.0, 0.004])
def test_the_tip_ends_at_the_point_whatever_the_plane(offset: float) -> None:
    settings = dataclasses.replace(SETTINGS, target_offset=offset)
    tip, reachable, _ = steer(settings, offset=offset)
    assert np.linalg.norm(tip - TARGET) < 0.0006
    assert reachable[0]
    assert reachable[-1]


def test_a_point_to_the_side_stays_in_reach_as_the_needle_bends_to_it() -> None:
    aside = (0.02, 0.005, 0.08)
    tip, reachable, _ = steer(dataclasses.replace(SETTINGS, target_point=aside))
    assert np.linalg.norm(tip - aside) < 0.0006
    assert all(reachable[:-5])


def test_a_point_that_moves_on_the_way_is_followed() -> None:
    moved = np.array([0.002, 0.001, 0.0])
    tip, _, _ = steer(SETTINGS, target_at=lambda k: np.array(TARGET) + moved * min(k / 40.0, 1.0))
    assert np.linalg.norm(tip - TARGET - moved) < 0.0006


def test_the_base_turns_no_more_than_its_budget() -> None:
    settings = dataclasses.replace(SETTINGS, rotation_budget=math.radians(600.0))
    turns: list[float] = []
    tip, _, _ = steer(settings, turns=turns)
    assert np.linalg.norm(tip - TARGET) < 0.001
    assert sum(turns) <= settings.rotation_budget + 1e-9
    free: list[float] = []
    steer(SETTINGS, turns=free)
    assert sum(free) > settings.rotation_budget


def breathing(time: float) -> Array:
    y = 0.003 * np.sin(2.0 * np.pi * 0.2 * time)
    return np.asarray(np.array(TARGET) + np.array([0.0, y, 2e-5 * time]))


def test_a_point_that_breathes_is_met_where_it_will_be() -> None:
    tip, _, time = steer(SETTINGS, seen_at=breathing)
    assert np.linalg.norm(tip - breathing(time)) < 0.0006


def test_a_point_stamped_by_another_clock_is_where_it_was_last_seen() -> None:
    """Nobody knows how old it is: what is foretold would be of another time."""
    resting, _, _ = steer(SETTINGS, seen_at=lambda _: np.array(TARGET))
    apart, _, _ = steer(SETTINGS, seen_at=lambda _: np.array(TARGET), clocks_apart=1.7e9)
    np.testing.assert_array_equal(apart, resting)
    placed, _, _ = steer(SETTINGS, seen_at=breathing, clocks_apart=None)
    stamped, _, _ = steer(SETTINGS, seen_at=breathing, clocks_apart=1.7e9)
    np.testing.assert_array_equal(stamped, placed)


def test_the_depth_ends_it_before_the_point() -> None:
    tip, reachable, _ = steer(
        dataclasses.replace(SETTINGS, target_point=(0.0, 0.0, 0.04), depth=0.05),
        target_at=lambda _: np.array([0.0, 0.0, 0.1]),
    )
    assert tip[2] == pytest.approx(0.05, abs=0.0005)
    assert not any(reachable)


@pytest.mark.parametrize(
    ("left", "length"), [(0.005, 0.001), (0.0004, 0.0004), (POINT_TOLERANCE, None), (-0.01, None)]
)
def test_the_last_step_ends_at_the_point(left: float, length: float | None) -> None:
    command = SteeringCommand(np.zeros(()), np.asarray(100.0), np.asarray(left))
    step = next_step(7, JointSample(7, 0.05, 1.0), command, SETTINGS, slowly=False)
    if length is None:
        assert step is None
        return
    assert step is not None
    assert step.insertion == pytest.approx(0.05 + length)
    assert step.rotation == pytest.approx(1.0 + 100.0 * length)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"target_point": (0.0, 0.1)}, "x, y and z"),
        ({"target_point": (0.04, 0.0, 0.06)}, "cannot be reached"),
        ({"preset": "paper"}, "paper cannot steer to a point"),
        ({"flip_depths": (0.05,)}, "flip_depths do not go together"),
        ({"target_point": (0.0, 0.0, 2.0)}, "target_point"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(UserError, match=said):
        dataclasses.replace(SETTINGS, **changes)  # type: ignore[arg-type]


def test_new_settings_keep_a_point_unless_they_change_it_or_cannot_steer_to_it() -> None:
    control = PlaneControl(SteeringSettings(**PAPER_NOISE), offset_plane(0.0))
    assert control.target_point is None
    control.target_point = np.array(TARGET)
    control.configure(SteeringSettings(max_rotation_per_length=300.0, **PAPER_NOISE))
    np.testing.assert_array_equal(control.target_point, TARGET)
    control.configure(SteeringSettings(target_point=(0.0, 0.0, 0.1), **PAPER_NOISE))
    np.testing.assert_array_equal(control.target_point, [0.0, 0.0, 0.1])
    control.configure(SteeringSettings(preset="paper", **PAPER_NOISE))
    assert control.target_point is None
