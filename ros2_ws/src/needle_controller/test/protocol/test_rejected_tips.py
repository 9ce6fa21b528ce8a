"""Rejected tips, covariances, and tip timeouts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from needle_controller.model.target_plane import plane_from_pose
from needle_controller.protocol.actions import Action, Awaiting, SteeringState
from needle_controller.protocol.tip_checks import TipCovariance, TipFault
from needle_core.component import Log
from needle_core.messages import Point

from .rig import HOLD, TICK, Rig, logged, none_sent, sent, spied, state_of

STEERING = SteeringState.STEERING


def bad(rig: Rig, position: list[float], frame: str = "rig", ahead: int = TICK) -> Point:
    return Point(rig.now + ahead, frame, (position[0], position[1], position[2]))


def covariance_at(rig: Rig, ahead: int = 0) -> TipCovariance:
    """Return the covariance of the tip exposed now."""
    return TipCovariance(rig.now + ahead, "rig", np.eye(3) * 1e-8)


def test_a_rejected_tip_causes_no_motion_and_another_is_awaited() -> None:
    rig = Rig()
    for position, frame, fault, cause in (
        ([np.nan, 0.0, 0.0], "rig", TipFault.NOT_FINITE, "not finite"),
        ([0.0, 0.0, 0.0], "map", TipFault.FRAME, "'map'"),
        ([0.5, 0.2, 1.0], "rig", TipFault.TOO_FAR, "from the entry point"),
    ):
        tip = bad(rig, position, frame)
        (log,) = rig.expose(tip)
        assert isinstance(log, Log)
        # Each reason is logged and counted separately.
        assert (log.kind, rig.steering.tips.rejected[fault]) == (f"tip {fault.value}", 1)
        assert cause in rig.steering.rejection
        assert log.text == rig.steering.reason == f"tip refused: {rig.steering.rejection}"
        assert not rig.steering.control.started
        assert state_of(rig) == (STEERING, Awaiting.TIP)
        assert rig.steering.tips.after_ns == tip.stamp_ns
    sent(rig.expose())
    assert rig.steering.rejection == ""


def test_an_implausible_tip_is_reported_even_if_none_is_awaited() -> None:
    rig = Rig()
    step = sent(rig.expose())
    assert "from the entry point" in logged(rig.steering.on_tip(bad(rig, [0.1, 0.0, 1.0])))
    assert rig.steering.on_tip(bad(rig, [0.0, 0.0, 1e-3])) == []
    assert rig.steering.tips.rejected == {TipFault.TOO_FAR: 1}
    rig.run(step)
    rig.steering.on_stop()
    rig.steering.on_tip(bad(rig, [0.1, 0.0, 1.0]))
    assert rig.steering.tips.rejected == {TipFault.TOO_FAR: 2}
    assert rig.steering.reason == "stopped"


def test_an_old_tip_is_rejected() -> None:
    rig = Rig()
    rig.steering.tips.after_ns = 0
    assert "older" in logged(rig.steering.on_tip(Point(1, "rig", (0.0, 0.0, 0.0))))
    rig.steps(1)
    assert "not newer" in logged(rig.steering.on_tip(bad(rig, [0.0] * 3, ahead=TICK - rig.now)))


def test_queued_tips_with_too_late_stamps_are_removed() -> None:
    rig = Rig()
    # At most a second ahead of the joints
    latest = rig.measured(ahead=10**9)
    for tip in (rig.measured(ahead=TICK), rig.measured(ahead=3 * TICK), latest):
        assert rig.steering.on_tip(tip) == []
    assert "ahead of joint_states" in logged(rig.steering.on_tip(rig.measured(ahead=10**9 + 1)))
    # The topic keeps its order: two stamps were too late, the first was good.
    assert rig.steering.on_tip(rig.measured(ahead=2 * TICK)) == []
    assert rig.steering.tips.rejected == {TipFault.AHEAD_OF_JOINTS: 3}
    rig.now += TICK
    assert sent(rig.joints()).stamp_ns == rig.now


def test_a_tip_timeout_ends_with_a_good_tip() -> None:
    rig = Rig()
    assert rig.steering.on_time(100.0) == rig.steering.on_time(101.9) == []
    text = logged(rig.steering.on_time(102.0))
    assert text == "WAITING_FOR_TIP: no good tip for 2 s"
    assert rig.steering.watchdog_trips == 1
    assert rig.steering.on_time(106.0) == []
    rig.expose(bad(rig, [np.nan] * 3))
    assert state_of(rig) == (SteeringState.WAITING_FOR_TIP, Awaiting.TIP)
    actions = rig.expose()
    assert "STEERING: received a good tip" in logged(actions)
    rig.run(sent(actions))
    assert rig.steering.state is STEERING
    # The reason names the last rejection; a stop also works while it waits.
    rig.expose(bad(rig, [np.nan] * 3))
    rig.steering.on_time(200.0)
    assert "the last one was refused: tip is not finite" in logged(rig.steering.on_time(202.0))
    assert rig.start() == "already steering"
    assert rig.steering.on_stop()[0].message == "stopped"


def test_missing_inputs_are_named_after_the_tip_timeout() -> None:
    for covariance, cause in (
        ("configured", "joint_states do not show the end of step 4"),
        ("from_tip_pose", "set it to configured"),
    ):
        rig = Rig(tip_covariance=covariance)
        rig.steps(3 * (covariance == "configured"))
        actions = rig.expose()
        if covariance == "configured":
            rig.steering.on_result(sent(actions).stamp_ns, "succeeded")
        rig.steering.on_time(0.0)
        assert rig.steering.on_time(1.9) == []
        rig.steering.on_time(2.0)
        assert rig.steering.state is SteeringState.WAITING_FOR_TIP
        assert cause in rig.steering.reason


def test_time_does_not_run_while_a_person_pauses() -> None:
    rig = Rig(held=False)
    rig.steering.on_time(0.0)
    assert rig.steering.on_time(1e6) == []
    rig.steering.on_device(HOLD)
    assert rig.steering.on_time(2e6) == []
    step = sent(rig.expose())
    assert rig.steering.on_time(3e6) == []
    rig.run(step)
    assert rig.steering.on_time(4e6) == []


def test_a_tip_without_joints_expires() -> None:
    rig = Rig()
    # Also in state WAITING_FOR_TIP.
    for start in (0.0, 100.0):
        rig.steering.on_tip(rig.measured(ahead=TICK))
        rig.steering.on_time(start)
        assert "no joint_states" not in logged(rig.steering.on_time(start + 1.99))
        assert "no joint_states" in logged(rig.steering.on_time(start + 2.0))
        rig.now += 2 * TICK
    assert rig.steering.tips.rejected == {TipFault.NO_JOINTS: 2}
    assert rig.steering.watchdog_trips == 3
    sent(rig.expose())


def test_a_tip_waits_for_its_covariance_in_any_order() -> None:
    steps = []
    for order in itertools.permutations(("joints", "tip", "covariance")):
        rig = Rig(tip_covariance="from_tip_pose")
        rig.now += TICK
        actions: list[Action] = []
        for topic in order:
            assert none_sent(actions)
            if topic == "joints":
                actions = rig.joints()
            elif topic == "tip":
                actions = rig.steering.on_tip(rig.measured(0.0004))
            else:
                actions = rig.steering.on_tip_pose(covariance_at(rig))
        steps.append(sent(actions))
    assert len(set(steps)) == 1


def test_the_covariance_turns_with_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    # x of this plane is y of rig.
    rig.steering.control.plane = plane_from_pose(
        "rig", [0.0, 0.003, 0.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    )
    calls = spied(rig, monkeypatch.setattr, "correct")
    headings = spied(rig, monkeypatch.setattr, "correct_heading")
    rig.expose()
    rig.run(sent(rig.steering.on_tip_pose(covariance_at(rig))))
    rig.expose()
    matrix = np.diag([1.0, 4.0, 9.0]) * 1e-8
    matrix[0, 2] = matrix[2, 0] = 1e-8
    heading = np.array([0.6, 0.0, 0.8]), 1e-4
    sent(rig.steering.on_tip_pose(TipCovariance(rig.now, "rig", matrix, heading)))
    wanted = np.array([[4.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, -1.0, 9.0]]) * 1e-8
    # measurement_std^2 is added.
    wanted += rig.steering.settings.measurement_std**2 * np.eye(3)
    np.testing.assert_allclose(np.asarray(calls[0][1]), wanted, atol=1e-14)
    # Headings within 10 mm repeat their error: ten steps count as one.
    direction, variance = headings[0]
    np.testing.assert_allclose(np.asarray(direction), [0.0, -0.6, 0.8], atol=1e-12)
    assert variance == pytest.approx(1e-3)


def test_a_tip_with_a_bad_covariance_is_rejected() -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    actions = rig.steering.on_tip_pose(TipCovariance(rig.now, "map", np.eye(3)))
    assert none_sent(actions)
    assert "frame 'map'" in logged(actions)
    assert rig.steering.tips.rejected == {TipFault.BAD_COVARIANCE: 1}
    rig.expose()
    sent(rig.steering.on_tip_pose(covariance_at(rig)))


def test_a_later_covariance_shows_that_the_tips_own_is_lost() -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    assert rig.steering.on_tip_pose(covariance_at(rig, ahead=-TICK)) == []
    actions = rig.steering.on_tip_pose(covariance_at(rig, ahead=TICK))
    assert "no needle/tip_pose" in logged(actions)
    assert rig.steering.tips.rejected == {TipFault.NO_COVARIANCE: 1}
    assert rig.steering.tips.after_ns == rig.now
    # The tip of the later covariance is used for the next step.
    sent(rig.expose())
