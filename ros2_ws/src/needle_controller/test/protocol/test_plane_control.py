"""Estimator and law of one needle in closed loop: to a plane, to a point, past obstacles."""

from __future__ import annotations

import dataclasses
import math
import pickle
import re
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

from needle_controller.filter import hypothesis_filter
from needle_controller.model.arrays import Array
from needle_controller.model.reachability import least_insertion
from needle_controller.model.target_plane import offset_plane
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.presets.path_steering import path_planner
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_controller.protocol.actions import next_step
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl
from needle_controller.protocol.tip_checks import TipCovariance
from needle_sim.needle.plant import NeedlePlant, initial_pose

NOISE = 0.0005
POINT, PAST = (0.004, -0.003, 0.05), (0.003, -0.004, 0.07)
PLANE = SteeringSettings(**{**PAPER_NOISE, "tip_noise_bound": NOISE}, target_offset=0.003)
TO_POINT = SteeringSettings(target_point=POINT, **PAPER_NOISE)
# A sphere of 2 mm in the middle of the path.
TO_PAST = SteeringSettings(
    target_point=PAST,
    depth=0.15,
    entry_angle_std=math.radians(2.0),
    obstacles=(0.001, -0.002, 0.04, 0.001, -0.002, 0.04, 0.002),
    **PAPER_NOISE,
)
WALL = Obstacles([Obstacle((-0.06, 0.0, 0.04), (0.06, 0.0, 0.04), 0.011)])


class Needle:
    """An exact needle, and a controller that gets noisy tips."""

    def __init__(
        self, settings: SteeringSettings, *, turned: float = 0.0, starts_deg: float = 15.0
    ) -> None:
        start = initial_pose(np.deg2rad(2.0), np.deg2rad(starts_deg) + turned)
        self.plant = NeedlePlant(start, curvature=1 / 0.122)
        self.settings, self.control = settings, PlaneControl(settings)
        self.joints = JointSample(0, 0.0, turned)
        self.rng = np.random.default_rng(5)
        self.turns, self.least_clearance, self.blocked = 0.0, math.inf, False
        self.track: list[float] = []
        self.reachable: list[bool] = []

    @property
    def tip(self) -> Array:
        return np.array(self.plant.T_rig_tip[:3, 3])

    @property
    def time(self) -> float:
        return self.joints.stamp_ns * 1e-9

    def steer(
        self, steps: int = 200, *, before: Callable[[int], object] = lambda _: None
    ) -> Needle:
        """Steer for a number of steps of half a second, or to the end."""
        for k in range(steps):
            before(k)
            clearance, joints = self.control.obstacles.clearance(self.tip), self.joints
            self.least_clearance = min(self.least_clearance, clearance)
            update = self.control.update(self.tip + self.rng.uniform(-NOISE, NOISE, 3), joints)
            self.reachable.append(update.reach.reachable)
            step = next_step(joints, update.command, self.settings, slowly=False)
            self.blocked = update.blocked
            if step is None or update.blocked:
                break
            length, turn = step.insertion - joints.insertion, step.rotation - joints.rotation
            self.plant.advance(length, turn)
            self.turns += abs(turn)
            stamp_ns = joints.stamp_ns + round(5e8 * length / self.settings.step_length)
            self.joints = JointSample(stamp_ns, step.insertion, step.rotation)
            self.track.append(abs(float(self.tip[0]) - self.settings.target_offset))
        return self

    def off(self, target: object) -> float:
        return float(np.linalg.norm(self.tip - np.asarray(target)))


@pytest.mark.parametrize(
    ("changes", "turned"),
    [
        ({"preset": "paper"}, 0.0),
        ({"tip_noise": "normal", "measurement_std": NOISE / math.sqrt(3.0)}, 0.0),
        ({}, -3.0),
        ({"max_winding": 7.0}, 17.0),
    ],
)
def test_a_needle_is_steered_into_the_plane_however_its_base_was_turned(
    changes: dict[str, object], turned: float
) -> None:
    needle = Needle(dataclasses.replace(PLANE, **changes), turned=turned)  # type: ignore[arg-type]
    needle.steer(60)
    # The base unwinds on the way.
    assert abs(needle.joints.rotation) < needle.settings.max_winding
    assert max(needle.steer(60).track[-20:]) < 1e-3


def test_a_flip_turns_the_bevel_over_and_holds_the_plane() -> None:
    needle = Needle(dataclasses.replace(PLANE, flip_depths=(0.07,))).steer(69)
    assert needle.plant.T_rig_tip[0, 0] > 0.25
    needle.steer(51)
    assert needle.plant.T_rig_tip[0, 0] < -0.25
    assert max(needle.track[69:]) < 1e-3


def test_construction_compiles_the_code_of_all_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("start_needle", "advance_needle", "correct_needle", "estimate_needle")
    calls: list[tuple[str, tuple[object, ...]]] = []
    for name in names:
        compiled = getattr(hypothesis_filter, name)

        def noted(*given: object, name: str = name, compiled: Any = compiled) -> None:
            calls.append((name, tuple(numba.typeof(argument) for argument in given)))
            compiled(*given)

        monkeypatch.setattr(hypothesis_filter, name, noted)
    needle = Needle(PLANE)
    at_construction = set(calls)
    assert {name for name, _ in at_construction} == set(names)
    needle.steer(3)
    covariance = TipCovariance(0, "rig", np.eye(3) * 1e-6)
    needle.control.update(needle.tip, needle.joints, covariance)
    assert set(calls) == at_construction


def test_a_change_of_preset_keeps_the_estimated_pose() -> None:
    for before, after in (("best", "paper"), ("paper", "best"), ("open_loop", "paper")):
        needle = Needle(dataclasses.replace(PLANE, preset=before)).steer(40)
        pose = needle.control._estimator.estimate()
        needle.control.configure(dataclasses.replace(PLANE, preset=after))
        kept = needle.control._estimator.estimate()
        np.testing.assert_allclose(kept.position, pose.position, atol=1e-9)
        assert kept.linearized[1] == pytest.approx(pose.linearized[1], abs=1e-3)
        if after != "best":
            # s does not represent the side of +-90 deg of the roll; the mean of a new bank
            # of hypotheses lies between both.
            assert kept.linearized[2] == pytest.approx(pose.linearized[2], abs=1.0)
        elif before == "paper":
            assert max(needle.steer(80).track[-20:]) < 1e-3


def test_an_update_contains_turn_miss_probability_and_reach() -> None:
    needle = Needle(PLANE, turned=1.0)
    needle.steer(3)
    # An encoder at rest may read one count less.
    joints = JointSample(9, needle.joints.insertion - 1e-6, 1.5)
    update = needle.control.update(needle.tip, joints)
    assert update.turned == pytest.approx(0.5)
    assert update.miss_probability == update.estimate.miss
    assert not update.blocked
    needle.control.target_point = np.array(POINT)
    update = needle.control.update(needle.tip, joints)
    # The tip is far from the point.
    assert update.miss_probability == pytest.approx(1.0)
    needle.control.restart()
    assert not needle.control.started
    assert needle.control.update(needle.tip, joints).turned == 0.0


def test_the_remaining_depth_decides_reachability() -> None:
    needed = float(least_insertion([-0.003, 0.0, 0.0], PLANE.curvature, tolerance=1e-3))
    to_point = dataclasses.replace(TO_POINT, target_point=(0.0, 0.0, 0.05))
    for settings, least, end in ((PLANE, needed, needed), (to_point, 0.05, 0.049)):
        for spare, expected in ((1e-6, True), (-1e-6, False)):
            control = PlaneControl(dataclasses.replace(settings, depth=end + 0.002 + spare))
            reach = control.update(np.zeros(3), JointSample(0, 0.002, 0.0)).reach
            assert reach.reachable is expected, settings
            assert reach.depth == pytest.approx(least + 0.002, abs=2e-9)


@pytest.mark.parametrize("offset", [0.0, 0.004])
def test_the_tip_ends_at_the_point_for_any_plane(offset: float) -> None:
    needle = Needle(dataclasses.replace(TO_POINT, target_offset=offset)).steer()
    assert needle.off(POINT) < 0.0006
    assert needle.reachable[0]
    assert needle.reachable[-1]
    budget = math.radians(600.0)
    within = Needle(dataclasses.replace(needle.settings, rotation_budget=budget)).steer()
    assert within.off(POINT) < 0.001
    assert within.turns <= budget + 1e-9 < needle.turns


def breathing(time: float) -> Array:
    y = 0.003 * np.sin(2.0 * np.pi * 0.2 * time)
    return np.asarray(np.array(POINT) + np.array([0.0, y, 2e-5 * time]))


def test_a_moving_point_is_reached_if_its_clock_is_known() -> None:
    ends = []
    for apart in (0.0, 1.7e9, None):
        needle = Needle(TO_POINT)

        def observe(_: int, needle: Needle = needle, apart: float | None = apart) -> None:
            if apart is None:
                needle.control.target_point = breathing(needle.time)
            else:
                needle.control.observe_target_point(breathing(needle.time), needle.time + apart)

        needle.steer(30, before=observe)
        ends.append(needle.tip)
        if apart == 0.0:
            needle.steer(before=observe)
            assert needle.off(breathing(needle.time)) < 0.0006
    # With stamps of another clock, the last observed position is used.
    np.testing.assert_array_equal(ends[1], ends[2])
    assert math.dist(ends[0], ends[1]) > 1e-5


def test_new_settings_keep_targets_and_obstacles_unless_they_change_them() -> None:
    control = PlaneControl(TO_PAST)
    control.plane = offset_plane(0.005)
    control.target_point, control.obstacles = np.array(POINT), WALL
    # Equal settings are other objects.
    same = pickle.loads(pickle.dumps(TO_PAST))
    control.configure(dataclasses.replace(same, max_rotation_per_length=300.0))
    assert (control.plane.offset, control.obstacles) == (0.005, WALL)
    np.testing.assert_array_equal(control.target_point, POINT)
    further = (*PAST[:2], 0.08)
    control.configure(
        dataclasses.replace(TO_PAST, target_offset=0.002, target_point=further, obstacles=())
    )
    assert (control.plane.offset, len(control.obstacles)) == (0.002, 0)
    np.testing.assert_array_equal(control.target_point, further)
    control.configure(dataclasses.replace(PLANE, preset="paper"))
    assert control.target_point is None


def test_the_planner_gets_its_settings() -> None:
    settings = SteeringSettings(depth=0.0, needle_diameter=0.002, goal_tolerance=0.003)
    found = path_planner(settings).settings
    assert (found.needle_radius, found.goal_tolerance, found.longest) == (0.001, 0.003, 0.0)


def test_the_needle_reaches_a_point_past_an_obstacle() -> None:
    settings = dataclasses.replace(TO_PAST, target_offset=0.004)
    needle = Needle(settings, starts_deg=10.0)
    assert needle.control.path_problem(0.0) == ""
    needle.steer()
    assert not needle.blocked
    assert needle.off(PAST) < 0.001
    assert needle.least_clearance > 0.00035


def test_the_reason_without_path_names_an_entry_with_a_path() -> None:
    control = PlaneControl(TO_PAST)
    control.obstacles = Obstacles([Obstacle((0.0, 0.0, 0.003), (0.0, 0.0, 0.003), 0.004)])
    assert "the entry is -0.001 m from an obstacle" in control.path_problem(0.0)

    def problem(x: float, y: float) -> str:
        """Return the problem of an entry past a wall that ends at y = 6 mm."""
        walls = [
            Obstacle((-0.06 - x, at - y, 0.025), (0.06 - x, at - y, 0.025), 0.011)
            for at in (-0.045, -0.025, -0.005)
        ]
        control.obstacles = Obstacles(walls)
        control.target_point = np.array([-x, 0.008 - y, 0.1])
        return control.path_problem(0.0)

    (place,) = re.findall(r"entry at \((.*?)\) m instead of \(0, 0\)", problem(0.0, 0.0))
    x, y = (float(part) for part in place.split(","))
    assert y > 0.0
    assert problem(x, y) == ""
