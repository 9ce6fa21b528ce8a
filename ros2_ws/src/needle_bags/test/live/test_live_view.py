"""live_view as a component: what viewers and clients of its port receive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from needle_bags.figures.film import Projection
from needle_bags.live import live_view
from needle_bags.live.live_messages import ADD
from needle_bags.live.live_view import LiveView, LiveViewParameters, Watched
from needle_core import messages as m
from needle_core.component import (
    LATCHED,
    Actions,
    Diagnose,
    Listen,
    Moment,
    Output,
    Peers,
    Publish,
    Send,
)
from needle_core.status_messages import ControllerStatus
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views

CALIBRATION = Path(__file__).parents[4] / "src/needle_tracker/config/calibration.yaml"
TIP = (0.001, 0.002, 0.04)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
LEFT = live_view.PICTURES["left"]
RAW, RAW_RIGHT = (f"stereo/{side}/image_raw" for side in ("left", "right"))
EXPOSED = 5_000_000_000
TARGETS = ControllerStatus(target_offset_m=0.003, target_point_m=(0.01, 0.0, 0.1))


class Bench:
    """live_view with messages, viewers and clients of the test."""

    def __init__(self, *, transforms: bool = False, foxglove_port: int = 0) -> None:
        settings = LiveViewParameters(foxglove_port=foxglove_port)
        self.view = LiveView(settings, transforms=transforms)
        self.now = 10.0
        self.published: dict[str, Any] = {}
        self.sent: dict[str, Any] = {}
        self.health: dict[str, str] = {}

    @property
    def at(self) -> Moment:
        return Moment(self.now, round(self.now * 1e9))

    def execute(self, actions: Actions) -> None:
        for action in actions:
            match action:
                case Publish():
                    self.published[action.topic] = action.message
                case Send():
                    self.sent |= {topic: message for topic, message, _ in action.batch}
                case Diagnose():
                    self.health[action.part] = action.diagnostic.message

    def subscribe(self, *topics: str) -> None:
        """Make these the topics with a subscriber."""
        peers = Peers(subscribers=dict.fromkeys(topics, ("viewer",)))
        self.execute(self.view.on_peers(peers, self.at))

    def receive(self, topic: str, message: Any) -> None:
        (row,) = (row for row in self.view.inputs if row.topic == topic)
        self.execute(row.handler(message, self.at))

    def receive_calibration(self) -> None:
        self.receive("stereo_tracker/calibration", m.Text(CALIBRATION.read_text("utf-8")))

    def receive_needle(self) -> None:
        """Receive a detected tip, an estimate, a plane and a point."""
        self.receive("joint_states", inserted(0.04))
        self.receive("needle/controller_status", TARGETS)
        self.receive("needle/tip_pose", pose("rig", 1e-4))
        # In the frame of the plane, offset by 3 mm.
        self.receive("needle/estimate", pose("target_plane", 2e-4))

    def update(self, seconds: float = 0.1) -> dict[str, Any]:
        """Advance time and run the timer; return what it published."""
        self.now += seconds
        self.published.clear()
        self.execute(self.view.timers[0].handler(self.at))
        return self.published

    def markers(self) -> dict[str, m.Marker]:
        """Return the markers that are drawn now."""
        markers = self.update()[live_view.MARKERS].markers
        return {marker.namespace: marker for marker in markers if marker.action == ADD}


def pose(frame: str, sigma: float, stamp_ns: int = EXPOSED) -> m.PoseWithCovariance:
    covariance = tuple(np.diag(np.full(6, sigma**2)).ravel().tolist())
    return m.PoseWithCovariance(stamp_ns, frame, TIP, UPRIGHT, covariance)


def inserted(insertion: float) -> m.JointState:
    return m.JointState(1, ("insertion_joint",), (insertion,))


def test_known_quantities_are_drawn_and_the_others_deleted() -> None:
    bench = Bench()
    bench.subscribe(live_view.MARKERS, live_view.TIP, live_view.PATH)
    bench.receive("needle/controller_status", TARGETS)
    assert set(bench.markers()) == {"plane", "target_point"}
    assert len(bench.published[live_view.MARKERS].markers) == 6
    bench.receive("joint_states", inserted(0.04))
    bench.receive("needle/tip_pose", pose("rig", 1e-4))
    drawn = bench.markers()
    assert drawn["shaft"].points[-1] == TIP
    assert drawn["uncertainty"].scale == pytest.approx((2 * 2.7955e-4,) * 3)
    assert drawn["plane"].position[0] == pytest.approx(0.003)
    assert (drawn["plane"].frame_id, drawn["plane"].stamp_ns) == ("rig", bench.at.stamp_ns)
    assert bench.published[live_view.TIP] == m.Pose(EXPOSED, "rig", TIP, UPRIGHT)
    assert bench.published[live_view.PATH].positions[-1] == TIP
    bench.receive("needle/estimate", pose("target_plane", 2e-4))
    drawn = bench.markers()
    assert drawn["estimate"].points[0] == pytest.approx((TIP[0] + 0.003, *TIP[1:]))
    assert drawn["uncertainty"].scale == pytest.approx((4 * 2.7955e-4,) * 3)
    # A tip that was not found is grey.
    bench.receive("needle/tip_pose", pose("rig", np.inf, 2 * EXPOSED))
    assert bench.markers()["tip"].colour == (0.7, 0.7, 0.7, 1.0)


def test_topics_without_subscriber_are_neither_published_nor_received() -> None:
    bench = Bench()
    bench.receive_needle()
    assert bench.update() == {}
    bench.subscribe(live_view.PATH)
    assert set(bench.update()) == {live_view.PATH}
    peers = Peers(subscribers={LEFT: ("viewer",)})
    for found, is_wanted in ((peers, True), (Peers(), False)):
        listens = list(bench.view.on_peers(found, bench.at))
        assert listens == [Listen(RAW, is_wanted), Listen(RAW_RIGHT, False)]
    assert {row.topic for row in bench.view.inputs if row.lazy} == {RAW, RAW_RIGHT}


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("joint_states", inserted(1e300)),
        ("joint_states", m.JointState(1, ("other_joint",), (0.0,))),
        ("needle/estimate", pose("target_plane", np.nan)),
        ("needle/controller_status", ControllerStatus(target_offset_m=20.0)),
        ("target_plane", m.Pose(1, "elsewhere", (0.0, 0.0, 0.0), UPRIGHT)),
        ("stereo_tracker/calibration", m.Text("none")),
    ],
)
def test_an_implausible_message_is_rejected(topic: str, message: Any) -> None:
    bench = Bench()
    bench.receive_needle()
    bench.subscribe(live_view.MARKERS)
    before = bench.markers()
    bench.receive(topic, message)
    assert bench.health[topic].startswith("refused: ")
    after = bench.markers()
    assert after.keys() == before.keys()
    for name in ("estimate", "shaft"):
        assert after[name].points == before[name].points
    # Health recovers with a good message.
    bench.receive("joint_states", inserted(0.04))
    assert bench.health["joint_states"] == "ok"


# ---- images


@pytest.fixture(scope="module")
def left_view() -> Projection:
    """Compiled projection of the left camera."""
    project = stereo_views(load_calibration(CALIBRATION))[0].project
    project(np.array(TIP))
    return project


def black(stamp_ns: int) -> m.Image:
    camera = load_calibration(CALIBRATION).left
    size = camera.width * camera.height
    return m.Image(stamp_ns, "", camera.height, camera.width, "mono8", camera.width, bytes(size))


def test_an_image_is_drawn_with_its_answer(left_view: Projection) -> None:
    bench = Bench()
    bench.receive_needle()
    bench.receive_calibration()
    bench.subscribe(LEFT)
    bench.receive(RAW, black(2 * EXPOSED))
    assert bench.update() == {}
    bench.receive("needle/tip_pose", pose("rig", 1e-4, 2 * EXPOSED))
    shown = bench.update()[LEFT]
    assert (shown.stamp_ns, shown.format) == (2 * EXPOSED, "jpeg")
    assert shown.frame_id == "left_camera_optical"
    picture = cv2.imdecode(np.frombuffer(shown.data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    camera = load_calibration(CALIBRATION).left
    assert picture.shape == (camera.height, camera.width, 3)
    u, v = np.round(left_view(np.array(TIP)))
    ring = picture[int(v) - 12 : int(v) + 13, int(u) - 12 : int(u) + 13]
    # Orange: red over green over blue.
    assert (ring[..., 2].astype(int) - ring[..., 0] > 100).sum() > 20


def test_images_of_another_camera_or_before_a_subscription_are_not_shown() -> None:
    bench = Bench()
    bench.receive_calibration()
    bench.receive(RAW, black(1))
    bench.subscribe(LEFT)
    bench.receive(RAW, black(2))
    # It still waits for its answer when the viewer leaves.
    bench.subscribe()
    bench.subscribe(LEFT)
    bench.receive(RAW, m.Image(3, "", 2, 3, "mono8", 3, bytes(6)))
    assert "the calibration is for" in bench.health[RAW]
    for _ in range(2):
        assert bench.update(1.0) == {}
    bench.receive(RAW, black(4))
    assert bench.update(1.0)[LEFT].stamp_ns == 4


# ---- transforms and clients


def test_transforms_are_published_if_the_message_type_is_installed() -> None:
    bench = Bench(transforms=True)
    assert Output(live_view.TF_STATIC, m.Transforms, LATCHED) in bench.view.outputs
    assert not any(row.message == m.Transforms for row in Bench().view.outputs)
    bench.receive_calibration()
    assert set(bench.published) == {live_view.TF_STATIC, live_view.ROBOT_DESCRIPTION}
    bench.subscribe(live_view.TF)
    # Nothing is sent before there is data.
    assert bench.update() == {}
    bench.receive("needle/controller_status", ControllerStatus(target_offset_m=0.003))
    bench.receive("needle/tip_pose", pose("rig", 1e-4))
    plane, tip = bench.update()[live_view.TF].transforms
    assert (plane.child_frame_id, plane.translation) == ("target_plane", (0.003, 0.0, 0.0))
    assert tip == m.Transform(EXPOSED, "rig", "needle_tip", TIP, UPRIGHT)


def test_clients_receive_watched_topics_and_latched_ones_alone() -> None:
    bench = Bench(foxglove_port=1)
    (port,) = bench.view.ports
    latched = {"needle/controller_status", live_view.TF_STATIC, live_view.ROBOT_DESCRIPTION}
    watched = {LEFT, "joint_states", "needle/reduced_state", live_view.TF}
    state = m.Vector(1, "target_plane", TIP)
    for topics in (set(), watched, set()):
        actions = list(port.handler([Watched(frozenset(topics))], bench.at))
        # Images are also received if only clients of the port request them.
        assert actions == [Listen(RAW, LEFT in topics), Listen(RAW_RIGHT, False)]
        bench.sent.clear()
        bench.receive_calibration()
        bench.receive("needle/reduced_state", state)
        bench.receive(RAW, black(EXPOSED))
        bench.receive_needle()
        bench.update()
        assert bench.sent.keys() == latched | topics
        assert bench.sent.get("needle/reduced_state", state) == state
        assert bench.published == {}
    # Without the port, unneeded topics are not received.
    assert "needle/reduced_state" not in {row.topic for row in Bench().view.inputs}
