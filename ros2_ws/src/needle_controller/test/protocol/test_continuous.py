"""Continuous insertion: what path a tip leads to, and which tips are used."""

from __future__ import annotations

import numpy as np
import pytest

from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import (
    Action,
    Awaiting,
    PublishUpdate,
    SendPath,
    SteeringState,
)
from needle_controller.protocol.step_watch import MOST_REFUSALS
from needle_controller.protocol.tip_gate import TipMeasurement

from .rig import FREE, HELD, MOVING, TICK, Rig, logged, sent, where

MM = 1e-3


def path_in(actions: list[Action]) -> SendPath:
    paths = [action for action in actions if isinstance(action, SendPath)]
    assert len(paths) == 1, actions
    return paths[0]


def updates_in(actions: list[Action]) -> int:
    return sum(isinstance(action, PublishUpdate) for action in actions)


class ContinuousRig(Rig):
    """A rig whose needle follows the newest path."""

    path: SendPath | None = None

    def __init__(self, *, depth: float = 0.12, held: bool = True) -> None:
        super().__init__(depth=depth, held=held, way="continuous")

    def go(self, distance: float) -> list[Action]:
        """Go on along the path, then see the tip; return what that leads to."""
        assert self.path is not None
        knots = np.array(self.path.points)
        self.insertion = min(self.insertion + distance, knots[-1, 0])
        self.rotation = float(np.interp(self.insertion, knots[:, 0], knots[:, 1]))
        return self.see()

    def see(self, x: float = 0.0) -> list[Action]:
        actions = self.expose(
            TipMeasurement(self.now + 20_000_000, "rig", np.array([x, 0.0, self.insertion]))
        )
        paths = [action for action in actions if isinstance(action, SendPath)]
        self.path = paths[-1] if paths else self.path
        return actions


def test_a_tip_leads_to_the_turn_of_a_step_and_a_path_beyond() -> None:
    stepwise, rig = Rig(), ContinuousRig()
    step, path = sent(stepwise.expose()), path_in(rig.see())
    (start, knot, end) = path.points
    assert start == (0.0, 0.0, 0.0)
    assert knot == pytest.approx((step.insertion, step.rotation, step.duration))
    assert end == pytest.approx((2 * MM, step.rotation, 2 * step.duration))
    assert path.stamp_ns == rig.now
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)


def test_a_tip_within_a_step_length_only_renews_the_path() -> None:
    rig = ContinuousRig()
    first = path_in(rig.see())
    actions = rig.go(0.4 * MM)
    again = path_in(actions)
    assert updates_in(actions) == 0
    assert again.stamp_ns > first.stamp_ns
    assert again.points[:2] == first.points[:2]
    assert again.points[2][0] == pytest.approx(2.4 * MM)
    assert again.points[2][1] == first.points[2][1]
    assert rig.steering.step == 0
    assert updates_in(rig.go(0.6 * MM)) == 1
    assert rig.steering.step == 1


def test_the_path_of_a_needle_that_went_back_begins_where_the_needle_is() -> None:
    rig = ContinuousRig()
    first = path_in(rig.see())
    rig.insertion = -0.2 * MM
    again = path_in(rig.see())
    assert again.points[0] == (-0.2 * MM, 0.0, 0.0)
    assert [point[:2] for point in again.points[1:2]] == [first.points[1][:2]]
    speed = first.points[1][0] / first.points[1][2]
    assert again.points[1][2] == pytest.approx((first.points[1][0] + 0.2 * MM) / speed)


@pytest.mark.parametrize("tips_per_step", [2, 6, 20])
def test_what_is_believed_and_turned_does_not_depend_on_how_many_tips_there_are(
    tips_per_step: int,
) -> None:
    rng = np.random.default_rng(3)
    noise = rng.uniform(-MM, MM, 8)
    few, many = ContinuousRig(), ContinuousRig()
    for rig, parts in ((few, 1), (many, tips_per_step)):
        rig.see(float(noise[0]))
        for x in noise[1:]:
            for part in range(1, parts):
                # Of the same place on the path, with errors of their own.
                rig.insertion += MM / parts
                knots = np.array(rig.path.points) if rig.path else np.zeros((1, 3))
                rig.rotation = float(np.interp(rig.insertion, knots[:, 0], knots[:, 1]))
                rig.see(5e-4 * part / parts)
            knots = np.array(rig.path.points) if rig.path else np.zeros((1, 3))
            rig.insertion = knots[1, 0]
            rig.rotation = knots[1, 1]
            rig.see(float(x))
    a, b = (rig.steering.control for rig in (few, many))
    assert few.steering.step == many.steering.step == 7
    assert few.path is not None
    assert many.path is not None
    # The way is followed in pieces or at once: the filter is linear in neither to the last bit.
    np.testing.assert_allclose(many.path.points, few.path.points, rtol=0, atol=2e-3)
    assert a.started
    assert b.started


def test_at_rest_no_tip_is_used_twice() -> None:
    rig = ContinuousRig()
    rig.see()
    for _ in range(50):
        assert updates_in(rig.see()) == 0
    assert rig.steering.step == 0


def test_the_path_ends_at_the_depth_and_steering_there() -> None:
    rig = ContinuousRig(depth=2.5 * MM)
    rig.see()
    while rig.insertion < 2.5 * MM:
        rig.go(0.3 * MM)
        assert rig.path is not None
        assert rig.path.points[-1][0] <= 2.5 * MM
    assert rig.steering.state is SteeringState.DONE
    assert "reached" in rig.steering.reason
    assert rig.steering.on_result(rig.steering.command_ns, "succeeded") == []


def test_without_hold_no_path_and_after_it_only_from_a_new_tip() -> None:
    rig = ContinuousRig()
    rig.see()
    rig.steering.on_device(MOVING)
    rig.go(0.4 * MM)
    command = rig.steering.command_ns
    rig.steering.on_result(command, "aborted: hold released")
    rig.steering.on_device(FREE)
    assert where(rig) == (SteeringState.STEERING, Awaiting.HOLD)
    assert not [action for action in rig.see() if isinstance(action, SendPath)]
    assert rig.steering.on_device(HELD) == []
    assert path_in(rig.see()).stamp_ns == rig.now


def test_an_answer_that_a_path_was_taken_asks_for_nothing() -> None:
    rig = ContinuousRig()
    first = path_in(rig.see())
    rig.go(0.2 * MM)
    for text in ("replaced", "succeeded"):
        assert rig.steering.on_result(first.stamp_ns, text) == []
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)


@pytest.mark.parametrize("late", [1, 3])
def test_refusals_that_come_when_newer_paths_are_sent_are_a_fault_too(late: int) -> None:
    rig = ContinuousRig()
    stamps = [path_in(rig.see()).stamp_ns for _ in range(late)]
    heard = 0
    while rig.steering.state is SteeringState.STEERING:
        heard += 1
        stamps.append(path_in(rig.see()).stamp_ns)
        rig.steering.on_result(stamps[-1 - late], "aborted: no")
        assert heard < 100
    # Each that counts was sent when the one before was known.
    assert heard == 1 + (MOST_REFUSALS - 1) * (late + 1)
    assert "without motion" in rig.steering.reason


def test_refusals_of_all_that_a_cut_cable_held_back_count_once() -> None:
    rig = ContinuousRig()
    stamps = [path_in(rig.see()).stamp_ns for _ in range(3 * MOST_REFUSALS)]
    for stamp in stamps:
        rig.steering.on_result(stamp, "aborted: nobody holds to run")
    assert where(rig) == (SteeringState.STEERING, Awaiting.TIP)


def test_paths_count_again_after_time_was_set_back_and_steering_started() -> None:
    rig = ContinuousRig()
    rig.now = 500 * TICK
    rig.settle()
    rig.steering.on_result(path_in(rig.see()).stamp_ns, "aborted: no")
    rig.now = TICK
    rig.settle()
    assert rig.steering.state is SteeringState.IDLE
    assert rig.steering.on_start()[0].success
    assert "aborted" in logged(rig.steering.on_result(path_in(rig.see()).stamp_ns, "aborted: no"))


def test_paths_that_are_refused_in_a_row_are_a_fault() -> None:
    rig = ContinuousRig()
    for _ in range(MOST_REFUSALS):
        assert rig.steering.state is SteeringState.STEERING
        path = path_in(rig.see())
        rig.steering.on_result(path.stamp_ns, "aborted: no")
    assert rig.steering.state is SteeringState.FAULT


def test_no_tips_is_waiting_and_a_good_one_ends_it() -> None:
    rig = ContinuousRig()
    rig.see()
    rig.steering.on_time(0.0)
    rig.steering.on_time(2.1)
    assert where(rig)[0] is SteeringState.WAITING_FOR_TIP
    assert "a good tip came" in logged(rig.go(0.2 * MM))
    assert where(rig)[0] is SteeringState.STEERING


def test_the_estimator_is_moved_along_the_way_that_the_joints_went(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = ContinuousRig()
    rig.see()
    way: list[tuple[float, float]] = []
    estimator = rig.steering.control._estimator
    advance = estimator.advance

    def spy(length: float, turn: float) -> None:
        way.append((length, turn))
        advance(length, turn)

    monkeypatch.setattr(estimator, "advance", spy)
    for mm, rad in ((0.25, 0.0), (0.5, 0.1), (0.75, 0.2), (1.0, 0.4)):
        rig.now += 20_000_000
        rig.steering.on_joints(JointSample(rig.now, mm * MM, rad))
    rig.insertion, rig.rotation = MM, 0.4
    rig.see()
    assert np.array(way) == pytest.approx(
        np.array([[0.25e-3, 0.0], [0.25e-3, 0.1], [0.25e-3, 0.1], [0.25e-3, 0.2]])
    )
