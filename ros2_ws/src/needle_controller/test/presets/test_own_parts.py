"""Estimators, laws and planners of other packages: discovery, trials and limits."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from needle_controller.observers.estimator import pose_estimate
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_planner import entry_state
from needle_controller.presets.own_controllers import OwnLaw, checked_estimator, checked_law
from needle_controller.presets.own_parts import GROUPS, OwnPartError
from needle_controller.presets.path_steering import OwnPlanner, PathSteering, checked_planner
from needle_controller.presets.point_steering import point_law
from needle_controller.presets.presets import make_controller
from needle_controller.presets.steering_settings import PAPER_NOISE, SteeringSettings
from needle_core.errors import UserError

ESTIMATOR = """
import numpy as np
from needle_controller.model.arc_motion import arc
from needle_controller.observers.estimator import pose_estimate


class Own:
    def __init__(self, settings, initial_rotation, entry, rng):
        self.settings, self.start, self.rng = settings, initial_rotation, rng

    def reset(self, tip, joints):
        self.place = tip
        self.turn = self.start
        self.chance = self.rng.random()

    def advance(self, d_insertion, d_rotation):
        step = arc(d_insertion, d_rotation, self.settings.curvature)
        self.place = self.place + self.turn @ step.shift
        self.turn = self.turn @ step.rotation

    def correct(self, tip, covariance, age):
        self.place = np.where(np.isfinite(tip), tip, self.place)

    def estimate(self):
        return pose_estimate(self.place, self.turn, self.settings.curvature, np.eye(6) * 1e-6)

    def change_frame(self, T_new_old):
        self.place = self.place @ T_new_old[:3, :3].T + T_new_old[:3, 3]
        self.turn = T_new_old[:3, :3] @ self.turn
"""
LAW = """
import numpy as np


class Own:
    def __init__(self, settings):
        self.settings = settings

    def to_plane(self, estimate, insertion):
        return 40.0 * insertion

    def to_point(self, estimate, target):
        return 0.0
"""
PLANNER = """
import numpy as np


class Own:
    def __init__(self, settings):
        self.settings = settings

    def via_points(self, tip, target, obstacles):
        if len(obstacles) > 1:
            return None
        if len(obstacles) == 1:
            return np.array([[0.0, -0.01, 0.04], target])
        return [target]
"""
Offer = Callable[..., str]
NUMBERS = itertools.count()


@pytest.fixture
def offer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Offer:
    """Return a function that installs a package with a class `Own`, and returns its name."""

    def make(kind: str, source: str, name: str = "") -> str:
        module = f"own_module_{next(NUMBERS)}"
        about = tmp_path / module / f"{module}-1.0.dist-info"
        about.mkdir(parents=True)
        (about.parent / f"{module}.py").write_text(source)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        entry_point = f"[{GROUPS[kind]}]\n{name or module} = {module}:Own\n"
        (about / "entry_points.txt").write_text(entry_point)
        monkeypatch.syspath_prepend(about.parent)
        return name or module

    return make


def test_an_own_estimator_replaces_the_presets(offer: Offer) -> None:
    name = offer("estimator", ESTIMATOR)
    settings = SteeringSettings(estimator=name, **PAPER_NOISE)
    assert settings.controller == f"best with estimator {name}"
    chances = []
    # The random numbers depend on seed and needle.
    for seed, number in ((0, 0), (0, 500), (1, 0), (0, 500)):
        settings = SteeringSettings(estimator=name, seed=seed, **PAPER_NOISE)
        estimator, law = make_controller(settings, np.eye(3), number=number)
        estimator.reset([0.003, 0.0, 0.0], [0.0, 0.0])
        chances.append(estimator._own.chance)  # type: ignore[attr-defined]
    assert len(set(chances)) == 3
    assert chances[1] == chances[3]
    estimator.advance(0.001, 0.0)
    estimator.correct([0.0028, 0.0, 0.001])
    found = estimator.estimate()
    np.testing.assert_allclose(found.position, [0.0028, 0.0, 0.001])
    assert float(law(found, 0.001).rotation_rate) != 0.0


HEADING = """
    def correct_heading(self, direction, variance):
        self.turn = self.turn @ rotation_exp(np.cross([0, 0, 1.0], self.turn.T @ direction))
"""


def test_an_own_estimator_may_use_a_measured_heading(offer: Offer) -> None:
    own = ESTIMATOR.replace("import arc", "import arc, rotation_exp") + HEADING
    for source, z in ((own, math.cos(0.1)), (ESTIMATOR, 1.0)):
        settings = SteeringSettings(estimator=offer("estimator", source), preset="paper")
        settings = dataclasses.replace(settings, measured_heading=True)
        estimator, _ = make_controller(settings, np.eye(3))
        estimator.reset([0.0, 0.0, 0.0], [0.0, 0.0])
        estimator.correct_heading([0.0, math.sin(0.1), math.cos(0.1)], 1e-4)  # type: ignore[attr-defined]
        assert estimator.estimate().rotation[2, 2] == pytest.approx(z, abs=1e-4)
    wrong = offer("estimator", own.replace("(self, direction, variance)", "(self, direction)"))
    with pytest.raises(OwnPartError, match="correct_heading raised TypeError"):
        checked_estimator(wrong)


def test_invalid_estimators_are_rejected_with_the_reason(offer: Offer) -> None:
    for sound, wrong, cause in (
        ("    def correct(self", "    def not_correct(self", "lacks correct(tip, covariance, age)"),
        ("class Own", "class Other", "has no attribute 'Own'"),
        ("import numpy as np", "numpy", "loading it raised NameError"),
        ("= settings, initial", "= setting, initial", "raised NameError"),
        ("return pose_estimate(", "return (", "returned tuple, expected an Estimate"),
        ("(self.place, self.turn", "(self.place * np.nan, self.turn", "contains nan"),
        ("(self.place, self.turn", "(1e3 * self.place, self.turn", "expected m, in"),
        ("curvature, np.eye", "curvature * 0, np.eye", "curvature is 0 1/m, expected > 0"),
        ("reset(self, tip, joints)", "reset(self, tip)", "reset(tip, joints) raised TypeError"),
        ("np.where(np.isfinite(tip), tip, self.place)", "tip", "contains nan"),
        ("+ T_new_old[:3, 3]", "- T_new_old[:3, 3]", "change_frame by 0.002 m along x moves x by"),
        ("@ step.shift", "@ step.shif", "advance(d_insertion, d_rotation) raised AttributeError"),
    ):
        assert sound in ESTIMATOR
        name = offer("estimator", ESTIMATOR.replace(sound, wrong))
        with pytest.raises(OwnPartError, match=rf"^estimator '{name}") as error:
            checked_estimator(name)
        text = str(error.value)
        assert cause in text
        assert "docs/own_controllers.md" in text
        assert "\n" not in text


def test_a_name_is_offered_by_one_package_and_is_a_class(offer: Offer) -> None:
    name = offer("estimator", ESTIMATOR)
    with pytest.raises(UserError, match=rf"available: .*{name} \({name} 1.0\)"):
        SteeringSettings(estimator="nobody")
    with pytest.raises(UserError, match=r"law = 'own_module_\d+': no installed package"):
        SteeringSettings(law=name)
    for _ in range(2):
        offer("law", LAW, name="both")
    several = r"several packages: own_module_\d+ 1.0, own_module_\d+ 1.0"
    with pytest.raises(UserError, match=several):
        SteeringSettings(law="both")
    function = offer("law", "def Own(estimate):\n    return 0.0\n")
    with pytest.raises(OwnPartError, match=r"is a function, expected a class .* \(settings\)"):
        checked_law(function)


def test_an_own_law_is_limited_and_gets_the_remaining_insertion(offer: Offer) -> None:
    settings = SteeringSettings(law=offer("law", LAW), max_rotation_per_length=10.0)
    _, law = make_controller(settings, np.eye(3))
    estimate = pose_estimate(np.zeros(3), np.eye(3), 8.0, np.eye(6))
    assert float(law(estimate, 0.1).rotation_rate) == pytest.approx(4.0)
    assert float(law(estimate, 1.0).rotation_rate) == 10.0
    own = OwnLaw(checked_law(settings.law), settings).to_point
    # A quarter of a circle of 50 mm radius, and behind.
    for target, left in (((0.05, 0.0, 0.05), 0.05 * np.pi / 2.0), ((0.0, 0.0, -0.02), -0.02)):
        for to_point in (own, point_law(settings, is_prompt=True)):
            assert to_point(estimate, target).insertion_left == pytest.approx(left)


def test_invalid_laws_are_rejected_with_the_reason(offer: Offer) -> None:
    rate = "40.0 * insertion"
    for wrong, cause in (
        ("np.zeros(3)", "has shape (3,), expected ()"),
        ("'fast'", "is of type str"),
    ):
        with pytest.raises(OwnPartError) as error:
            checked_law(offer("law", LAW.replace(rate, wrong)))
        assert cause in str(error.value)
    # A law for planes alone is not tried with a point.
    name = offer("law", LAW.replace("def to_point", "def not_to_point"))
    with pytest.raises(UserError, match=r"cannot steer to a point: it lacks to_point"):
        SteeringSettings(law=name, target_point=(0.0, 0.0, 0.1))
    with pytest.raises(UserError, match="flip_depths"):
        SteeringSettings(law=name, flip_depths=(0.05,))


def test_an_own_planner_steers_by_its_via_points(offer: Offer) -> None:
    settings = SteeringSettings(planner=offer("planner", PLANNER))
    own = OwnPlanner(checked_planner(settings.planner), settings)
    way, target = PathSteering(settings), np.array([0.0, 0.0, 0.08])
    tip = entry_state(settings.curvature)
    sphere = Obstacle((0.0, 0.0, 0.04), (0.0, 0.0, 0.04), 0.003)
    for obstacles, aim, length in (
        (Obstacles(), target, None),
        (Obstacles([sphere]), np.array([0.0, -0.01, 0.04]), 2.0 * np.hypot(0.01, 0.04)),
    ):
        route = own.route(tip, target, obstacles)
        assert route is not None
        np.testing.assert_allclose(route.aim, aim)
        assert route.length == pytest.approx(length)
    assert way.find_first(target, Obstacles([sphere]), 0.0) == ""
    none = way.find_first(target, Obstacles([sphere, sphere]), 0.0)
    assert none == f"planner {settings.planner} finds no path to the target point past 2 obstacles"
    name = offer("planner", PLANNER.replace("return [target]", "return [target + 0.01]"))
    with pytest.raises(OwnPartError, match=r"does not end at the target \[0.0, 0.0, 0.08\] m"):
        checked_planner(name)
