"""Continuous insertion: paths, and the tips that are used."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from needle_controller.protocol import steering
from needle_controller.protocol.actions import (
    Action,
    Awaiting,
    PublishUpdate,
    SendPath,
    SteeringState,
)
from needle_controller.protocol.confidence import Confidence
from needle_controller.protocol.motion_monitors import MAX_ABORTS_AT_REST

from .rig import FREE, HOLD, MOVING, TICK, Rig, logged, sent, spied, state_of

MM = 1e-3
AT_WORK = (SteeringState.STEERING, Awaiting.TIP)


def paths_in(actions: list[Action]) -> list[SendPath]:
    return [action for action in actions if isinstance(action, SendPath)]


def path_in(actions: list[Action]) -> SendPath:
    (path,) = paths_in(actions)
    return path


def updates_in(actions: list[Action]) -> int:
    return sum(isinstance(action, PublishUpdate) for action in actions)


class ContinuousRig(Rig):
    """A rig whose needle follows the newest path."""

    path: SendPath | None = None

    def __init__(self, *, depth: float = 0.12) -> None:
        super().__init__(depth=depth, insertion_mode="continuous")

    def go(self, distance: float) -> list[Action]:
        """Advance along the path, at most to its end, and expose the tip."""
        assert self.path is not None
        insertions, rotations, _ = np.transpose(self.path.points)
        self.insertion = min(self.insertion + distance, insertions[-1])
        self.rotation = float(np.interp(self.insertion, insertions, rotations))
        return self.expose_tip()

    def expose_tip(self) -> list[Action]:
        actions = self.expose()
        self.path = [self.path, *paths_in(actions)][-1]
        return actions

    def refused(self) -> Iterator[int]:
        """Expose tips whose paths are aborted at once; yield their number until the fault."""
        count = 0
        while self.steering.state is SteeringState.STEERING:
            count += 1
            yield count
            self.steering.on_result(path_in(self.expose_tip()).stamp_ns, "aborted: no")


def test_a_tip_leads_to_the_rotation_of_a_step_and_a_path_beyond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step, rig = sent(Rig().expose()), ContinuousRig()
    path = path_in(rig.expose_tip())
    start, knot, end = path.points
    assert start == (0.0, 0.0, 0.0)
    assert knot == pytest.approx((step.insertion, step.rotation, step.duration))
    assert end == pytest.approx((2 * MM, step.rotation, 2 * step.duration))
    assert path.stamp_ns == rig.steering.command_ns == rig.now
    assert state_of(rig) == AT_WORK
    # An uncertain estimate halves the speed.
    doubtful = Confidence("doubtful", is_doubtful=True)
    monkeypatch.setattr(steering, "assess_confidence", lambda *_: doubtful)
    slow = path_in(ContinuousRig().expose_tip())
    assert slow.points[1][2] == pytest.approx(2.0 * step.duration)


def test_a_tip_within_a_step_length_only_renews_the_path() -> None:
    rig = ContinuousRig()
    first = path_in(rig.expose_tip())
    actions = rig.go(0.4 * MM)
    again = path_in(actions)
    assert updates_in(actions) == 0
    assert again.stamp_ns > first.stamp_ns
    assert again.points[:2] == first.points[:2]
    assert again.points[2][:2] == pytest.approx((2.4 * MM, first.points[2][1]))
    assert updates_in(rig.go(0.598 * MM)) == rig.steering.step == 0
    # At rest no tip is used twice.
    assert updates_in(rig.expose_tip()) == updates_in(rig.expose_tip()) == 0
    assert updates_in(rig.go(0.0015 * MM)) == rig.steering.step == 1


def test_the_path_begins_at_a_needle_that_went_back() -> None:
    rig = ContinuousRig()
    first = path_in(rig.expose_tip())
    rig.insertion = -0.2 * MM
    again = path_in(rig.expose_tip())
    assert again.points[0] == (-0.2 * MM, 0.0, 0.0)
    assert again.points[1][:2] == first.points[1][:2]
    assert again.points[2] == pytest.approx((1.8 * MM, first.points[1][1], 1.0))
    assert again.points[1][2] == pytest.approx(0.6)


def test_the_path_ends_at_the_depth_and_steering_there() -> None:
    rig = ContinuousRig(depth=2.5 * MM)
    rig.expose_tip()
    for distance in (1.0 * MM, 1.0 * MM, 0.5 * MM - 0.9e-5):
        assert path_in(rig.go(distance)).points[-1][0] <= 2.5 * MM
    # An axis rests off its goal: the last tip is used there, and the path leads to the end.
    assert rig.steering.insertion == rig.insertion
    rig.go(MM)
    assert rig.steering.state is SteeringState.DONE
    assert "insertion 0.0025 m reached" in rig.steering.reason
    assert rig.steering.on_result(rig.steering.command_ns, "aborted: no") == []


def test_the_path_ends_at_the_point_before_the_depth() -> None:
    rig = ContinuousRig()
    rig.steering.control.target_point = np.array([0.0, 0.0, 0.0015])
    assert path_in(rig.expose_tip()).points[-1][0] == pytest.approx(1.5 * MM, rel=0.01)


def test_without_hold_no_path_and_after_it_only_from_a_new_tip() -> None:
    rig = ContinuousRig()
    rig.expose_tip()
    rig.steering.on_device(MOVING)
    rig.go(0.4 * MM)
    actions = rig.steering.on_result(rig.steering.command_ns, "aborted: hold released")
    assert logged(actions) == "path aborted: hold released"
    rig.steering.on_device(FREE)
    assert state_of(rig) == (SteeringState.STEERING, Awaiting.HOLD)
    assert not paths_in(rig.expose_tip())
    assert rig.steering.on_device(HOLD) == []
    assert path_in(rig.expose_tip()).stamp_ns == rig.now


def test_an_accepted_path_resets_the_count_of_aborts() -> None:
    rig = ContinuousRig()
    for text in ("replaced", "succeeded"):
        for count in rig.refused():
            if count == MAX_ABORTS_AT_REST:
                break
        first = path_in(rig.expose_tip())
        rig.expose_tip()
        assert rig.steering.on_result(first.stamp_ns, text) == []
        assert state_of(rig) == AT_WORK
    # Answers to paths that were never sent are ignored.
    assert rig.steering.on_result(rig.steering.command_ns + 1, "aborted: no") == []


def test_aborts_in_a_row_are_a_fault() -> None:
    """Aborts of paths that were sent before an earlier abort arrived do not count."""
    for late in (0, 3):
        rig = ContinuousRig()
        stamps = [path_in(rig.expose_tip()).stamp_ns for _ in range(late)]
        for _ in range(1 + (MAX_ABORTS_AT_REST - 1) * (late + 1)):
            assert rig.steering.state is SteeringState.STEERING
            stamps.append(path_in(rig.expose_tip()).stamp_ns)
            rig.steering.on_result(stamps[-1 - late], "aborted: no")
        assert rig.steering.state is SteeringState.FAULT
        assert "without motion" in rig.steering.reason


def test_paths_are_sent_again_after_the_clock_went_back() -> None:
    rig = ContinuousRig()
    rig.now = 500 * TICK
    rig.settle()
    rig.steering.on_result(path_in(rig.expose_tip()).stamp_ns, "aborted: no")
    rig.now = TICK
    rig.settle()
    assert rig.start() == "steering"
    # A needle that is out restarts the estimate, with a new path.
    actions = rig.expose_tip()
    assert updates_in(actions) == 1
    assert "aborted" in logged(rig.steering.on_result(path_in(actions).stamp_ns, "aborted: no"))


def test_the_tip_timeout_ends_with_a_good_tip() -> None:
    rig = ContinuousRig()
    rig.expose_tip()
    for second in (0.0, 1.5, 3.0):
        # Tips that renew the path reset the timeout.
        assert rig.steering.on_time(second) == []
        rig.expose_tip()
    rig.steering.on_time(10.0)
    rig.steering.on_time(12.1)
    assert rig.steering.state is SteeringState.WAITING_FOR_TIP
    assert "received a good tip" in logged(rig.go(0.2 * MM))
    assert (rig.steering.state, rig.steering.reason) == (SteeringState.STEERING, "")


def test_the_estimator_follows_intermediate_joint_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = ContinuousRig()
    rig.expose_tip()
    advances = spied(rig, monkeypatch.setattr, "advance")
    for mm, rad in ((0.25, 0.0), (0.3, 0.05), (0.5, 0.1), (0.75, 0.2), (1.0, 0.4)):
        rig.insertion, rig.rotation = mm * MM, rad
        rig.settle(1)
    rig.expose_tip()
    assert np.array(advances) == pytest.approx(
        np.array([[0.25e-3, 0.0], [0.25e-3, 0.1], [0.25e-3, 0.1], [0.25e-3, 0.2]])
    )
