"""peer_topics: rows of the file, names and units of peers, and targets that they propose."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from needle_bags.live.peer_topics import (
    PeerTopic,
    PeerTopics,
    PeerTopicsParameters,
    read_peer_topics,
)
from needle_core import messages as m
from needle_core.component import Actions, Diagnose, Log, Moment, Publish
from needle_core.errors import UserError
from needle_core.status_messages import ControllerStatus

FILE = Path(__file__).parents[2] / "config" / "peers.yaml"
AT = Moment(0.0, 7_000_000_000)
TIP, TURN = (0.001, 0.002, 0.04), Rotation.from_euler("xyz", (0.1, 0.2, 0.3))
STAMP = 5_250_000_000


class Bench:
    """The component with a table of topics."""

    def __init__(self, *rows: PeerTopic) -> None:
        self.component = PeerTopics(PeerTopicsParameters(), rows)
        self.ticks = 0

    def receive(self, topic: str, message: Any) -> list[Any]:
        (row,) = (row for row in self.component.inputs if row.topic == topic)
        assert isinstance(message, row.message)
        return list(row.handler(message, AT))

    def published(self, actions: Actions | None = None) -> dict[str, Any]:
        if actions is None:
            (timer,) = self.component.timers
            self.ticks += 1
            actions = timer.handler(Moment(0.0, AT.stamp_ns + self.ticks))
        return {one.topic: one.message for one in actions if isinstance(one, Publish)}

    def insert(self, stamp_ns: int = STAMP) -> None:
        """Play a needle at 40 mm whose base is turned by 0.5 rad, with a target."""
        x, y, z, w = TURN.as_quat().tolist()
        covariance = tuple(np.diag(np.full(6, 1e-8)).ravel().tolist())
        joints = (m.INSERTION_JOINT, m.ROTATION_JOINT)
        self.receive("joint_states", m.JointState(stamp_ns + 1, joints, (0.04, 0.5), (0.001, 0.0)))
        tip = m.PoseWithCovariance(stamp_ns, "rig", TIP, (x, y, z, w), covariance)
        self.receive("needle/tip_pose", tip)
        status = ControllerStatus(target_offset_m=0.0, target_point_m=(0.01, -0.005, 0.1))
        self.receive("needle/controller_status", status)
        points = (m.TrajectoryPoint((0.041, 0.6), 0.5), m.TrajectoryPoint((0.042, 0.7), 1.0))
        self.receive("device/joint_trajectory", m.Trajectory(stamp_ns, joints, points))


def test_peers_read_the_needle_in_their_units() -> None:
    bench = Bench(*read_peer_topics(FILE))
    assert bench.published() == {"/needle/state/skin_entry": m.BarePoint((0.0, 0.0, 0.0))}
    bench.insert()
    found = bench.published()
    assert found.keys() == {row.topic for row in bench.component.outputs} - {
        "needle/proposed_target"
    }
    own, theirs = found["needle/shape"], found["/needle/state/current_shape"]
    assert (own.frame_id, theirs.frame_id, own.stamp_ns) == ("rig", "needle", STAMP)
    for (at, turn), (at_mm, same) in zip(own.poses, theirs.poses, strict=True):
        assert np.array(at) * 1e3 == pytest.approx(at_mm)
        assert turn == same
    assert (own.poses[0][0], own.poses[-1][0]) == ((0.0, 0.0, 0.0), pytest.approx(TIP))
    assert own.poses[-1][1] == pytest.approx(TURN.as_quat())
    base = found["/stage/state/needle_pose"]
    assert base.position == pytest.approx((0.0, 0.0, 40.0))
    assert 2.0 * np.arctan2(base.orientation[2], base.orientation[3]) == pytest.approx(0.5)
    measured, setpoint = found["needle/measured_js"], found["needle/setpoint_js"]
    assert (measured.positions, setpoint.positions) == ((0.04, 0.5), (0.042, 0.7))
    assert (measured.frame_id, measured.velocities) == ("rig", (0.001, 0.0))
    assert found["needle/measured_cp"].position == pytest.approx(TIP)


STAGE: dict[str, Any] = {
    "unit": "mm",
    "frame": "stage",
    "translation": (0.1, 0.02, 0.03),
    "rotation": (-0.5, -0.5, -0.5, 0.5),
}
# A point (x, y, z) in rig becomes (y, z, x) plus the translation, in mm.
STAGE_TARGET = (100.0 - 5.0, 20.0 + 100.0, 30.0 + 10.0)


def test_a_target_goes_out_and_comes_in_through_the_frame() -> None:
    out = Bench(PeerTopic("a", "target", **STAGE))
    out.insert()
    sent = out.published()["a"]
    assert (sent.frame_id, sent.position) == ("stage", pytest.approx(STAGE_TARGET))
    for stamped, frame in ((True, "stage"), (True, ""), (False, "")):
        row = PeerTopic("b", "proposed_target", stamped, **STAGE)
        message = m.Point(3, frame, STAGE_TARGET) if stamped else m.BarePoint(STAGE_TARGET)
        actions = Bench(row).receive("b", message)
        proposal = out.published(actions)["needle/proposed_target"]
        assert (proposal.frame_id, proposal.stamp_ns) == ("rig", AT.stamp_ns)
        assert proposal.position == pytest.approx((0.01, -0.005, 0.1))


@pytest.mark.parametrize(
    ("frame", "position", "problem"),
    [
        ("map", STAGE_TARGET, "its frame is 'map', expected 'stage'"),
        ("stage", (np.nan, 0.0, 0.0), "no target is at"),
        ("stage", (0.0, 0.0, 1e6), "no target is at"),
    ],
)
def test_a_bad_target_is_reported_and_not_proposed(frame: str, position: Any, problem: str) -> None:
    bench = Bench(PeerTopic("b", "proposed_target", **STAGE))
    log, health = bench.receive("b", m.Point(3, frame, position))
    assert isinstance(log, Log)
    assert isinstance(health, Diagnose)
    assert problem in log.text
    assert problem in health.diagnostic.message


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"topic": "a"}, "expected a list"),
        ([{"topic": "a"}], "content = '' is not one of shape, tip"),
        ([{"topic": "a", "content": "shape", "units": "mm"}], "did you mean 'unit'"),
        ([{"topic": "a", "content": "tip", "rotation": [0.0, 0.0, 1.0]}], "needs 4 numbers, has 3"),
        ([{"topic": "a", "content": "tip", "rotation": [0.0, 0.0, 0.0, 2.0]}], "norm of rotation"),
        ([{"topic": "a", "content": kind} for kind in ("target", "tip")], "a is listed twice"),
    ],
)
def test_a_wrong_row_is_named(tmp_path: Path, content: Any, problem: str) -> None:
    file = tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump(content), "utf-8")
    with pytest.raises(UserError, match=f"own.yaml: .*{re.escape(problem)}"):
        read_peer_topics(file)
