"""Checks of tips at their bounds."""

from __future__ import annotations

import numpy as np

from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.tip_checks import (
    AcceptedTip,
    TipCovariance,
    TipFault,
    check_message,
    check_position,
    check_stamp,
)
from needle_core.messages import Point

NAN, INF = np.nan, np.inf
MARGIN = 0.004
NOW = JointSample(100, 0.1, 0.0)


def tip(x: float, y: float, z: float) -> Point:
    return Point(100, "rig", (x, y, z))


LAST = AcceptedTip(tip(0.0, 0.0, 0.099), JointSample(50, 0.099, 0.0))


def test_unreachable_positions_are_rejected() -> None:
    rows: list[
        tuple[tuple[float, float, float], JointSample, AcceptedTip | None, TipFault | None]
    ] = [
        # Insertion times scale plus margin: 1.15 x 0.1 m + 4 mm.
        ((0.0, 0.0, 0.1189999), NOW, None, None),
        ((0.0, 0.0, 0.1190001), NOW, None, TipFault.TOO_FAR),
        ((-1e300, 0.2, 1.0), NOW, None, TipFault.TOO_FAR),
        # At a negative insertion only the margin is left.
        ((0.0, 0.00399, 0.0), JointSample(100, -0.1, 0.0), None, None),
        ((0.0, 0.00401, 0.0), JointSample(100, -0.1, 0.0), None, TipFault.TOO_FAR),
        # Since the last tip the needle has moved by 1 mm in either direction: 1 mm + 4 mm.
        ((0.003, 0.0, 0.1029999), NOW, LAST, None),
        ((0.003, 0.0, 0.1030001), NOW, LAST, TipFault.JUMP),
        ((0.0, 0.0, 0.0940001), JointSample(100, 0.098, 0.0), LAST, None),
        ((0.0, 0.0, 0.0939999), JointSample(100, 0.098, 0.0), LAST, TipFault.JUMP),
    ]
    for place, joints, last, wanted in rows:
        rejection = check_position(tip(*place), joints, last, MARGIN)
        assert (rejection.fault if rejection else None) is wanted, place


def test_rejections_name_the_value_and_its_limit() -> None:
    def at(stamp_ns: int) -> Point:
        return Point(stamp_ns, "rig", (0.03, 0.0, 0.09))

    last = AcceptedTip(at(2 * 10**9), JointSample(2 * 10**9, 0.099, 0.0))
    oldest, latest = last.joints, JointSample(3 * 10**9, 0.1, 0.0)
    for rejection, text in (
        (check_message(at(2 * 10**9), last), "not newer than the last used one's (0 s behind)"),
        (check_message(at(1_750_000_000), last), "(0.25 s behind)"),
        (check_message(at(2 * 10**9 + 1), last), ""),
        (check_stamp(at(2 * 10**9), oldest, latest), ""),
        (check_stamp(at(2 * 10**9 - 1), oldest, latest), "older than all stored joint_states"),
        (check_stamp(at(4_250_000_000), oldest, latest), "1.25 s ahead of joint_states"),
        (
            check_position(at(0), JointSample(0, 0.06, 0.0), None, 0.004),
            "tip is 0.09487 m from the entry point, limit 0.073 m "
            "(1.15 insertion 0.06 m + margin 0.004 m)",
        ),
        (
            check_position(tip(0.03, 0.0, 0.1), latest, last, 0.004),
            "tip jumped 0.01 m since the last used one, limit 0.005 m "
            "(insertion since then + margin 0.004 m)",
        ),
    ):
        assert rejection.text.endswith(text) if rejection and text else not (rejection or text)


def test_invalid_covariances_are_rejected() -> None:
    for matrix, cause in (
        (np.eye(3) * 1e-12, ""),
        # Relative to the largest entry.
        (1e-8 * (np.eye(3) + 0.9e-9 * np.eye(3, k=1)), ""),
        (1e-8 * (np.eye(3) + 1.1e-9 * np.eye(3, k=1)), "not symmetric"),
        (np.full((3, 3), NAN), "not a number"),
        (np.diag([INF] * 3), "no tip was found"),
        (np.diag([1.0, 1.0, -2.0]), "(its smallest variance is -2 m^2)"),
        (np.zeros((3, 3)), "not positive definite"),
        (np.diag([1.0, -1.0, 1.0]), "not positive definite"),
    ):
        problem = TipCovariance(0, "rig", matrix).problem()
        assert (cause in problem) if cause else not problem, matrix
    assert "frame 'map'" in TipCovariance(0, "map", np.eye(3)).problem()
    for z, variance, cause in (
        (1.0, 1e-4, ""),
        (0.9, 1e-4, "length 0.9"),
        (NAN, 1e-4, "length nan"),
        (1.0, 0.0, "variance 0 rad^2"),
        (1.0, NAN, "variance nan"),
    ):
        problem = TipCovariance(0, "rig", np.eye(3), (np.array([0.0, 0.0, z]), variance)).problem()
        assert (cause in problem) if cause else not problem, (z, variance)
