"""Tips with a covariance of their own."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from needle_controller.model.target_plane import plane_from_pose
from needle_controller.protocol.steering_types import Action, PublishUpdate, SteeringState
from needle_controller.protocol.tip_gate import Fault, TipCovariance, TipMeasurement

from .rig import TICK, Rig, logged, none_sent, sent


def told(rig: Rig, std: float = 1e-4, stamp: int | None = None) -> TipCovariance:
    """What a source says of the tip exposed now."""
    return TipCovariance(rig.now if stamp is None else stamp, "rig", np.eye(3) * std**2)


def test_a_tip_waits_for_its_covariance_in_whatever_order_they_come() -> None:
    steps = []
    for order in itertools.permutations(range(3)):
        rig = Rig(tip_covariance="from_tip_pose")
        rig.now += TICK
        tip, covariance = rig.measured(0.0004), told(rig)
        actions: list[Action] = []
        for number, topic in enumerate(order):
            assert none_sent(actions), order[:number]
            actions += (
                rig.joints,
                lambda rig=rig, tip=tip: rig.steering.on_tip(tip),
                lambda rig=rig, c=covariance: rig.steering.on_tip_pose(c),
            )[topic]()
        steps.append(sent(actions))
    assert len(set(steps)) == 1


def test_the_covariance_decides_what_a_tip_is_worth() -> None:
    """A tip 2 mm off the axis: believed if it is known to 0.1 mm, hardly if only to 2 mm."""
    seen = []
    for std in (1e-4, 2e-3):
        rig = Rig(tip_covariance="from_tip_pose")
        rig.expose()
        for _ in range(4):
            rig.run(sent(rig.steering.on_tip_pose(told(rig))))
            rig.expose()
        rig.run(sent(rig.steering.on_tip_pose(told(rig))))
        rig.expose(TipMeasurement(rig.now + TICK, "rig", np.array([0.0005, 0.0, rig.insertion])))
        (update,) = (
            a for a in rig.steering.on_tip_pose(told(rig, std)) if isinstance(a, PublishUpdate)
        )
        seen.append(update.update.estimate.position[0] + 0.003)
    assert seen[0] > 3 * seen[1] > 0.0


def test_the_covariance_turns_with_the_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    # x of this plane is y of rig.
    rig.steering.control.plane = plane_from_pose(
        "rig", [0.0, 0.003, 0.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    )
    taken: list[Any] = []
    estimator = rig.steering.control._estimator
    correct = estimator.correct

    def spy(tip: Any, covariance: Any) -> None:
        taken.append(covariance)
        correct(tip, covariance)

    monkeypatch.setattr(estimator, "correct", spy)
    rig.expose()
    rig.run(sent(rig.steering.on_tip_pose(told(rig))))
    rig.expose()
    matrix = np.diag([1.0, 4.0, 9.0]) * 1e-8
    matrix[0, 2] = matrix[2, 0] = 1e-8
    sent(rig.steering.on_tip_pose(TipCovariance(rig.now, "rig", matrix)))
    wanted = [[4.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, -1.0, 9.0]]
    left_out = rig.steering.control._settings.measurement_std**2 * np.eye(3)
    np.testing.assert_allclose(taken[0], np.array(wanted) * 1e-8 + left_out, atol=1e-14)


@pytest.mark.parametrize(
    ("matrix", "frame", "said"),
    [
        (np.full((3, 3), np.nan), "rig", "not a number"),
        (np.diag([np.inf] * 3), "rig", "no tip was found"),
        (np.zeros((3, 3)), "rig", "not positive definite"),
        (-np.eye(3), "rig", "not positive definite"),
        (np.eye(3) + np.eye(3, k=1), "rig", "not symmetric"),
        (np.eye(3) * 1e-8, "map", "frame 'map'"),
    ],
)
def test_a_tip_with_a_bad_covariance_is_refused(matrix: np.ndarray, frame: str, said: str) -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    actions = rig.steering.on_tip_pose(TipCovariance(rig.now, frame, matrix))
    assert none_sent(actions)
    assert said in logged(actions)
    assert rig.steering.intake.refused == {Fault.BAD_COVARIANCE: 1}
    rig.expose()
    sent(rig.steering.on_tip_pose(told(rig)))


def test_a_covariance_of_a_later_tip_says_that_the_tips_own_is_lost() -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    assert rig.steering.on_tip_pose(told(rig, stamp=rig.now - TICK)) == []
    actions = rig.steering.on_tip_pose(told(rig, stamp=rig.now + TICK))
    assert "no needle/tip_pose" in logged(actions)
    assert "configured" in logged(actions)
    assert rig.steering.watchdog_trips == 0
    assert rig.steering.intake.after_ns == rig.now
    # The tip of that one is there for the next step.
    sent(rig.expose())


def test_a_source_of_tips_alone_is_told_what_to_set() -> None:
    rig = Rig(tip_covariance="from_tip_pose")
    rig.expose()
    rig.steering.on_time(0.0)
    assert rig.steering.on_time(1.9) == []
    rig.steering.on_time(2.0)
    assert rig.steering.state is SteeringState.WAITING_FOR_TIP
    assert "set it to configured" in rig.steering.reason
    assert rig.steering.intake.refused == {Fault.NO_COVARIANCE: 1}


def test_configured_noise_asks_for_no_covariance_and_uses_none() -> None:
    steps = []
    for bad in (False, True):
        rig = Rig()
        for _ in range(3):
            if bad:
                rig.steering.on_tip_pose(TipCovariance(rig.now + TICK, "rig", np.zeros((3, 3))))
            steps.append(sent(rig.expose()))
            rig.run(steps[-1])
    assert steps[:3] == steps[3:]
