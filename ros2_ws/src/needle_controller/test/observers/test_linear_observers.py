"""The paper's observer with a Kalman gain, with measured pitch, and across flips of the bevel."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from needle_common.errors import UserError
from needle_controller.laws.bend_side_law import TwoSidedLinearizingLaw
from needle_controller.laws.flip_plan import FlipPlan, evenly_spaced_flips
from needle_controller.laws.law import LinearizingLaw
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.observers.bend_side import bend_sign_of, mirrored_turn, reduced_on_side
from needle_controller.observers.innovation_gate import InnovationGate
from needle_controller.observers.linear_observer import LinearObserver, LinearObserverSettings
from needle_controller.observers.luenberger import LuenbergerObserver
from needle_controller.observers.pitch_observer import PitchObserver, PitchObserverSettings
from needle_controller.presets.control_settings import ControlSettings
from needle_controller.presets.presets import make_law, observer_settings
from needle_sim.needle.plant import NeedlePlant

CONTROL = ControlSettings()
CURVATURE = CONTROL.curvature
STEP = 0.001


def settings(**changes: Any) -> LinearObserverSettings:
    made = LinearObserverSettings(
        curvature=CURVATURE,
        process_noise=np.diag(CONTROL.process_noise),
        measurement_std=CONTROL.measurement_std,
        initial_pitch_std=CONTROL.initial_pitch_std,
        initial_roll_std=CONTROL.initial_roll_std,
        initial_yaw_std=CONTROL.initial_yaw_std,
    )
    return dataclasses.replace(made, **changes)


def steady(**changes: Any) -> LinearObserver:
    return LinearObserver(settings(observer_poles=CONTROL.gains().observer_poles, **changes))


def kalman(**changes: Any) -> LinearObserver:
    return LinearObserver(settings(**changes))


def law() -> LinearizingLaw:
    made = make_law(CONTROL, CONTROL.gains())
    assert isinstance(made, LinearizingLaw)
    return made


def plant_at(reduced: Array) -> NeedlePlant:
    reduced = np.asarray(reduced, dtype=float)
    pose = np.zeros((*reduced.shape[:-1], 4, 4))
    pose[..., :3, :3] = rotation_from_angles(reduced * [0.0, 1.0, 1.0])
    pose[..., 0, 3] = reduced[..., 0]
    pose[..., 3, 3] = 1.0
    return NeedlePlant(pose, curvature=CURVATURE)


def true_reduced(plant: NeedlePlant) -> Array:
    pose = plant.T_rig_tip
    roll = np.arctan2(-pose[..., 0, 1], pose[..., 0, 0])
    return np.stack([pose[..., 0, 3], np.arcsin(pose[..., 0, 2]), roll], axis=-1)


def tip(plant: NeedlePlant) -> Array:
    return np.asarray(plant.T_rig_tip[..., :3, 3])


# One side.


@pytest.mark.parametrize("gate", [math.inf, 3.0])
def test_steady_gain_is_the_papers_observer(gate: float) -> None:
    """Beside `luenberger`, step for step, noise, missed and refused tips included."""
    rng = default_rng(1)
    settings = observer_settings(CONTROL, CONTROL.gains())
    one, other = (
        steady(gate=gate),
        LuenbergerObserver(dataclasses.replace(settings, gate=gate)),
    )
    tips = rng.normal(0.0, 1e-3, (40, 7, 3))
    tips[5, 2] = np.nan
    for each in (one, other):
        each.reset(tips[0], np.zeros(2))
    for k in range(1, 40):
        turn = rng.normal(0.0, 0.1, 7)
        for each in (one, other):
            each.advance(STEP, turn)
            each.correct(tips[k])
    a, b = one.estimate(), other.estimate()
    np.testing.assert_allclose(a.coordinates, b.coordinates, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-4, atol=1e-9)


def test_kalman_gain_minimises_the_covariance() -> None:
    """Any other gain, the steady one among them, leaves more; both settle at the same end."""
    one, other = kalman(gate=math.inf), steady(gate=math.inf)
    for each in (one, other):
        each.reset(np.zeros(3), np.zeros(2))
    for k in range(150):
        for each in (one, other):
            each.advance(STEP, 0.0)
            each.correct(np.zeros(3))
        mine, theirs = one.estimate().covariance, other.estimate().covariance
        assert np.all(np.diag(mine)[[0, 4, 5]] <= np.diag(theirs)[[0, 4, 5]] * (1 + 1e-9)), k
    # The steady gain is the continuous filter's: of the same kind, not the same to the digit.
    ratio = np.diag(theirs)[[0, 4, 5]] / np.diag(mine)[[0, 4, 5]]
    assert np.all(ratio < 1.25), ratio


def test_kalman_is_the_textbook_filter() -> None:
    """On the linear system itself: weighted least squares over all measurements, no noise in s."""
    rng = default_rng(2)
    one = kalman(process_noise=np.zeros((3, 3)), gate=math.inf)
    one.reset([0.0, 0.0, 0.0], [0.0, 0.0])
    depths = np.arange(1, 21) * STEP
    measured = rng.normal(0.0, 1e-4, 20)
    for x in measured:
        s = one.estimate().linearized
        # u that leaves s3 as it is, so that v = 0.
        pitch, roll = one.estimate().reduced[1:]
        after = np.arcsin(s[2] / CURVATURE / np.cos(pitch + CURVATURE * np.sin(roll) * STEP))
        drift = -CURVATURE * np.cos(roll) * np.tan(pitch) * STEP
        one.advance(STEP, after - roll - drift)
        one.correct([x, 0.0, 0.0])
    sigma = CONTROL.measurement_std
    prior = np.array([sigma, CONTROL.initial_pitch_std, CURVATURE * CONTROL.initial_roll_std])
    rows = np.stack([np.ones(20), depths, 0.5 * depths**2], axis=1)
    precision = rows.T @ rows / sigma**2 + np.diag(prior**-2.0)
    start = np.linalg.solve(precision, rows.T @ measured / sigma**2)
    end = np.array([[1, 0.02, 0.0002], [0, 1, 0.02], [0, 0, 1]]) @ start
    np.testing.assert_allclose(one.estimate().linearized, end, rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize("make", [kalman, steady])
def test_converges_without_noise(make: Any) -> None:
    plant, one, steer = plant_at(np.array([-0.003, 0.05, 0.3])), make(), law()
    one.reset(tip(plant), [0.0, 0.0])
    for _ in range(500):
        turn = float(steer(one.estimate()).rotation_rate) * STEP
        plant.advance(STEP, turn)
        one.advance(STEP, turn)
        one.correct(tip(plant))
    error = np.abs(one.estimate().reduced - true_reduced(plant))
    assert np.all(error < [1e-6, 1e-4, 1e-3]), error


def test_covariance_is_honest() -> None:
    rng, count = default_rng(3), 2000
    start = rng.normal(0.0, 1.0, (count, 3)) * [0.0, math.radians(5), math.radians(10)]
    plant = plant_at(start)
    one = kalman(
        process_noise=np.diag([0.0, 0.0, 1e-3]),
        initial_pitch_std=math.radians(5),
        initial_roll_std=math.radians(10),
        gate=math.inf,
    )
    one.reset(tip(plant) + rng.uniform(-1e-3, 1e-3, (count, 3)), np.zeros(2))
    for _ in range(30):
        plant.advance(STEP, 0.0)
        one.advance(STEP, 0.0)
        one.correct(tip(plant) + rng.uniform(-1e-3, 1e-3, (count, 3)))
    error = one.estimate().reduced - true_reduced(plant)
    of_reduced = one.estimate().covariance[:, [[0], [4], [5]], [[0, 4, 5]]]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(of_reduced), error)
    assert 2.5 < np.mean(nees) < 3.6


@pytest.mark.parametrize("make", [kalman, steady])
def test_broadcasting_equals_looping(make: Any) -> None:
    rng = default_rng(4)
    tips = rng.normal(0.0, 1e-3, (20, 5, 3))
    turns, ages = rng.normal(0.0, 0.1, (20, 5)), rng.choice([0.0, STEP], (20, 5))
    tips[3, 2], tips[7, 1] = np.nan, [0.02, 0.0, 0.0]
    many, single = make(), [make() for _ in range(5)]
    many.reset(tips[0], np.zeros(2))
    for i, one in enumerate(single):
        one.reset(tips[0, i], np.zeros(2))
    for k in range(1, 20):
        many.advance(STEP, turns[k])
        many.correct(tips[k], age=ages[k])
        for i, one in enumerate(single):
            one.advance(STEP, turns[k, i])
            one.correct(tips[k, i], age=ages[k, i])
    whole = many.estimate()
    for i, one in enumerate(single):
        alone = one.estimate()
        np.testing.assert_allclose(whole.coordinates[i], alone.coordinates, rtol=1e-9, atol=1e-13)
        np.testing.assert_allclose(whole.covariance[i], alone.covariance, rtol=1e-8, atol=1e-18)


@pytest.mark.parametrize("make", [kalman, steady])
def test_a_missing_tip_changes_nothing_and_an_outlier_is_refused(make: Any) -> None:
    one, other = make(), make()
    for each in (one, other):
        each.reset([0.001, 0.0, 0.0], [0.0, 0.1])
        for _ in range(10):
            each.advance(STEP, 0.02)
            each.correct([0.001, 0.0, 0.0])
        each.advance(STEP, 0.02)
    one.correct([np.nan, 0.0, 0.0])
    one.correct([0.0, 0.0, 0.0], covariance=np.diag([np.inf] * 3))
    assert one.estimate().warnings == ()
    one.correct([0.012, 0.0, 0.0])
    np.testing.assert_array_equal(one.estimate().coordinates, other.estimate().coordinates)
    np.testing.assert_array_equal(one.estimate().covariance, other.estimate().covariance)
    assert any("refused" in text for text in one.estimate().warnings)


def test_a_late_tip_is_compared_with_where_the_tip_was() -> None:
    one = kalman()
    one.reset([0.0, 0.0, 0.0], [0.0, 0.5])
    for _ in range(20):
        one.advance(STEP, 0.0)
    s, late = one.estimate().linearized, 5 * STEP
    one.correct([s[0] - late * s[1] + late**2 / 2 * s[2], 0.0, 0.015], age=late)
    np.testing.assert_allclose(one.estimate().linearized, s, atol=1e-12)


def test_gate_takes_a_tip_after_enough_refusals() -> None:
    gate = InnovationGate(9.0, 2)
    found, far = np.array([True, True, False]), np.array([10.0, 1.0, np.nan])
    assert gate.admit(far, found).tolist() == [False, True, False]
    assert gate.admit(far, found).tolist() == [False, True, False]
    assert gate.warnings() == ("tip refused by the innovation gate, 2 in a row",)
    assert gate.admit(far, found).tolist() == [True, True, False]
    assert gate.warnings() == ()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("curvature", 0.0),
        ("curvature", math.nan),
        ("measurement_std", -1e-3),
        ("initial_roll_std", 4.0),
        ("saturation_margin", 1.0),
        ("process_noise", np.diag([1.0, -1.0, 1.0])),
        ("process_noise", np.full((3, 3), np.nan)),
    ],
)
def test_bad_settings_are_named(name: str, value: Any) -> None:
    with pytest.raises(UserError, match=name):
        settings(**{name: value})


@pytest.mark.parametrize(("limit", "tips"), [(0.0, 4), (math.nan, 4), (9.0, 0)])
def test_bad_gates_are_refused(limit: float, tips: int) -> None:
    with pytest.raises(UserError):
        InnovationGate(limit, tips)


# Measured pitch.


def pitch_observer(**changes: Any) -> PitchObserver:
    return PitchObserver(PitchObserverSettings(settings(), **changes))


def test_pitch_error_of_the_curvature_decays_at_the_pole() -> None:
    plant, one = plant_at(np.array([0.0, 0.02, 0.4])), pitch_observer(pole=80.0)
    one.reset(tip(plant), [0.0, 0.0])
    one.correct(tip(plant), pitch=0.02)
    errors = []
    for _ in range(40):
        plant.advance(STEP, 0.0)
        one.advance(STEP, 0.0)
        one.correct(tip(plant), pitch=float(true_reduced(plant)[1]))
        s3 = linearized_from_reduced(true_reduced(plant), CURVATURE)[2]
        errors.append(abs(float(one.estimate().linearized[2] - s3)))
    np.testing.assert_allclose(errors[25] / errors[5], math.exp(-80.0 * 0.020), rtol=0.03)


def test_first_pitch_does_not_count_as_a_change() -> None:
    one = pitch_observer()
    one.reset(np.zeros(3), np.zeros(2))
    one.advance(STEP, 0.0)
    before = one.estimate().linearized[2]
    one.correct([0.0, 0.0, 0.001], pitch=0.1)
    np.testing.assert_allclose(one.estimate().reduced[1], 0.1)
    assert one.estimate().linearized[2] == before


def test_pitch_covariance_is_honest() -> None:
    rng, count, std = default_rng(5), 2000, math.radians(2.0)
    plant = plant_at(rng.normal(0.0, 1.0, (count, 3)) * [0.0, 0.05, 0.15])
    linear = settings(process_noise=np.zeros((3, 3)), initial_roll_std=0.15, gate=math.inf)
    one = PitchObserver(PitchObserverSettings(linear, pitch_std=std))
    one.reset(tip(plant) + rng.uniform(-1e-3, 1e-3, (count, 3)), np.zeros(2))
    for _ in range(40):
        plant.advance(STEP, 0.0)
        one.advance(STEP, 0.0)
        pitch = true_reduced(plant)[:, 1] + rng.normal(0.0, std, count)
        one.correct(tip(plant) + rng.uniform(-1e-3, 1e-3, (count, 3)), pitch=pitch)
    error = (
        one.estimate().linearized[:, 2]
        - linearized_from_reduced(true_reduced(plant), CURVATURE)[:, 2]
    )
    sigma = math.sqrt(float(one._covariance.reshape(-1, 3, 3)[0, 2, 2]))
    assert 0.9 < np.std(error) / sigma < 1.1


def test_without_pitch_only_x_is_taken() -> None:
    one = pitch_observer()
    one.reset(np.zeros((2, 3)), np.zeros(2))
    one.advance(STEP, 0.1)
    before = one.estimate().linearized
    one.correct(np.array([[0.0005, 0, 0.001], [np.nan, 0, 0]]))
    after = one.estimate().linearized
    np.testing.assert_allclose(after[0], [0.0005, *before[0, 1:]])
    np.testing.assert_array_equal(after[1], before[1])


@pytest.mark.parametrize(("name", "value"), [("pole", 0.0), ("pitch_std", math.inf)])
def test_bad_pitch_settings_are_named(name: str, value: float) -> None:
    with pytest.raises(UserError, match=name):
        pitch_observer(**{name: value})


# Both sides.


@pytest.mark.parametrize("roll", [0.0, 0.4, -1.2, 1.9, -2.5, 3.0])
def test_s_and_its_side_say_the_whole_roll(roll: float) -> None:
    reduced = np.array([0.001, 0.2, roll])
    s = linearized_from_reduced(reduced, CURVATURE)
    np.testing.assert_allclose(reduced_on_side(s, CURVATURE, bend_sign_of(roll)), reduced)
    for sign in (1.0, -1.0):
        turned = roll + mirrored_turn(roll, sign)
        assert np.sin(turned) == pytest.approx(np.sin(roll))
        assert bend_sign_of(turned) == sign


def test_two_sided_law_is_the_papers_law_near_roll_0_and_its_mirror_image_near_pi() -> None:
    """Seen from behind, x and roll pi - g: the same needle, turned the other way."""
    one = steady()
    one.reset(np.array([[0.002, 0, 0], [-0.001, 0, 0]]), np.array([[0.0, 0.3], [0.0, -0.5]]))
    here = one.estimate()
    upright = law()(here).rotation_rate
    two = TwoSidedLinearizingLaw(law())
    np.testing.assert_allclose(two(here).rotation_rate, upright, rtol=1e-9)
    other = steady()
    other.reset(one.estimate().position, np.array([[0.0, np.pi - 0.3], [0.0, np.pi + 0.5]]))
    np.testing.assert_allclose(other.estimate().linearized, here.linearized, atol=1e-12)
    np.testing.assert_allclose(two(other.estimate()).rotation_rate, -upright, rtol=1e-9)


@pytest.mark.parametrize("at_once", [True, False])
def test_closed_loop_holds_the_plane_over_flips(at_once: bool) -> None:
    """At once: turned between two steps; else over the steps that 30 deg/mm take."""
    rng, count = default_rng(6), 60
    plant = plant_at(rng.uniform(-1, 1, (count, 3)) * [0.001, 0.05, 0.2])
    one, steer = kalman(), TwoSidedLinearizingLaw(law())
    plan = FlipPlan((0.08,)) if not at_once else evenly_spaced_flips(5, 0.14)
    one.reset(tip(plant), np.zeros(2))
    sides = []
    for k in range(140):
        sign = plan.bend_sign(k * STEP)
        one.flip_to(sign)
        if at_once:
            turn = mirrored_turn(one.estimate().reduced[:, 2], sign)
            plant.advance(0.0, turn)
            one.advance(0.0, turn)
        turn = steer(one.estimate(), sign).rotation_rate * STEP
        plant.advance(STEP, turn)
        one.advance(STEP, turn)
        one.correct(tip(plant) + rng.uniform(-0.3e-3, 0.3e-3, (count, 3)))
        sides.append(np.mean(np.cos(true_reduced(plant)[:, 2])))
    assert np.sqrt(np.mean(true_reduced(plant)[:, 0] ** 2)) < 0.6e-3
    assert np.max(np.abs(true_reduced(plant)[:, 0])) < 2e-3
    assert np.sign(sides[70]) == plan.bend_sign(0.0705)
    assert np.sign(sides[-1]) == plan.bend_sign(0.14)


def test_without_a_plan_the_estimate_stays_on_its_side() -> None:
    one = kalman()
    one.reset(np.zeros(3), [0.0, 1.2])
    one.advance(STEP, 1.0)
    assert one.bend_sign == 1.0
    assert one.estimate().reduced[2] < 0.5 * np.pi
    one.flip_to(-1.0)
    one.advance(0.0, 1.0)
    assert one.bend_sign == -1.0


@pytest.mark.parametrize(
    ("depths", "message"),
    [
        ((0.0,), "flip 1"),
        ((-0.01,), "flip 1"),
        ((0.02, 0.02), "flip 2"),
        ((0.01, math.nan), "not finite"),
        ((math.inf,), "not finite"),
    ],
)
def test_bad_plans_are_refused(depths: tuple[float, ...], message: str) -> None:
    with pytest.raises(UserError, match=message):
        FlipPlan(depths)


def test_a_plan_says_the_side_at_every_depth() -> None:
    plan = FlipPlan((0.02, 0.05))
    signs = plan.bend_sign([0.0, 0.0199, 0.02, 0.049, 0.06])
    np.testing.assert_array_equal(signs, [1, 1, -1, -1, 1])
    assert plan.next_flip(0.03) == 0.05
    assert plan.next_flip(0.05) == math.inf
    plan.check_within(0.12)
    with pytest.raises(UserError, match=r"flip 2 = 0\.05 m is outside \[0, 0\.05\]"):
        plan.check_within(0.05)
    assert FlipPlan(first_sign=-1.0).bend_sign(0.03) == -1.0
    assert evenly_spaced_flips(2, 0.12).depths == pytest.approx((0.04, 0.08))
    for count, depth in ((-1, 0.1), (1, 0.0)):
        with pytest.raises(UserError):
            evenly_spaced_flips(count, depth)
    with pytest.raises(UserError, match="first_sign"):
        FlipPlan(first_sign=0.0)


def test_a_flip_turns_the_error_of_the_curvature_round() -> None:
    """What the covariance says of s2 and s3 together has the sign of what many needles show."""
    rng, count = default_rng(7), 2000
    plant = plant_at(rng.normal(0.0, 1.0, (count, 3)) * [0.0, 0.05, 0.15])
    linear = settings(process_noise=np.zeros((3, 3)), initial_pitch_std=0.05, initial_roll_std=0.15)
    one = LinearObserver(linear)
    one.reset(tip(plant) + rng.uniform(-1e-3, 1e-3, (count, 3)), np.zeros(2))
    for _ in range(30):
        plant.advance(STEP, 0.0)
        one.advance(STEP, 0.0)
        one.correct(tip(plant) + rng.uniform(-1e-3, 1e-3, (count, 3)))
    correlations = []
    for sign in (1.0, -1.0):
        one.flip_to(sign)
        turn = mirrored_turn(one.estimate().reduced[:, 2], sign)
        plant.advance(0.0, turn)
        one.advance(0.0, turn)
        true = linearized_from_reduced(true_reduced(plant), CURVATURE)
        error = one.estimate().linearized - true
        said = np.mean(one._covariance.reshape(-1, 3, 3), axis=0)
        correlations.append(
            (
                np.corrcoef(error[:, 1], error[:, 2])[0, 1],
                said[1, 2] / np.sqrt(said[1, 1] * said[2, 2]),
            )
        )
    for seen, said in correlations:
        assert seen == pytest.approx(said, abs=0.15)
    assert correlations[0][0] * correlations[1][0] < 0.0
