"""live_view in virtual time, with a rig played by the test and viewers that start and stop."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from needle_bags.figures.film import Projection
from needle_bags.live import live_view
from needle_bags.live.live_messages import ADD
from needle_bags.live.live_view import FOXGLOVE, LiveView, LiveViewParameters, Watched
from needle_core import messages as m
from needle_core.component import (
    LATCHED,
    Actions,
    Component,
    Input,
    Listen,
    Moment,
    Output,
    Peers,
    Port,
    Publish,
    Send,
    Timer,
)
from needle_core.runners.virtual import VirtualRunner
from needle_core.status_messages import ControllerStatus
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views

CALIBRATION = Path(__file__).parents[4] / "src/needle_tracker/config/calibration.yaml"
TIP = (0.001, 0.002, 0.04)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
LEFT = live_view.PICTURES["left"]
RAW, RAW_RIGHT = (f"stereo/{side}/image_raw" for side in ("left", "right"))
EXPOSED = 5_000_000_000


class PlayedRig(Component):
    """Component that publishes messages of the test."""

    name = "played_rig"

    def __init__(self, view: LiveView) -> None:
        self.todo: deque[Publish] = deque()
        self.outputs = tuple(Output(row.topic, row.message, row.delivery) for row in view.inputs)
        self.timers = (Timer(0.01, lambda _: [self.todo.popleft() for _ in tuple(self.todo)]),)


class Viewer(Component):
    """Viewer that subscribes to some topics of the live view."""

    name = "viewer"

    def __init__(self, view: LiveView, topics: Iterable[str]) -> None:
        self.received: dict[str, list[Any]] = {topic: [] for topic in topics}
        self.inputs = tuple(
            Input(row.topic, row.message, partial(self._keep, row.topic), row.delivery)
            for row in view.outputs
            if row.topic in self.received
        )

    def _keep(self, topic: str, message: Any, at: Moment) -> Actions:
        self.received[topic].append(message)
        return ()


class Clients(Component):
    """Stands in for the port's server."""

    name = "clients"

    def __init__(self) -> None:
        self.received: list[tuple[str, Any, int]] = []
        self.todo: deque[Send] = deque()
        self.ports = (Port(FOXGLOVE, self._on_batch),)
        self.timers = (Timer(0.01, lambda _: [self.todo.popleft() for _ in tuple(self.todo)]),)

    def _on_batch(self, batch: Sequence[Any], at: Moment) -> Actions:
        self.received += batch
        return ()


class Scene:
    def __init__(self, *, transforms: bool = False, foxglove_port: int = 0) -> None:
        settings = LiveViewParameters(foxglove_port=foxglove_port)
        self.view = LiveView(settings, transforms=transforms)
        self.rig = PlayedRig(self.view)
        self.published: list[tuple[str, Any]] = []
        self.health: dict[str, str] = {}
        self.runner = VirtualRunner([self.view, self.rig], taps=[self._tap])
        self.runner.run(0.5)

    def _tap(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        if sender == self.view.name and isinstance(message, m.Diagnostics):
            self.health |= {status.part: status.text for status in message.statuses}
        elif sender == self.view.name and not isinstance(message, m.LogLine):
            self.published.append((output.topic, message))

    def open_viewer(self, *topics: str) -> Viewer:
        viewer = Viewer(self.view, topics)
        self.runner.start(viewer)
        self.runner.run(0.5)
        return viewer

    def publish(self, topic: str, message: Any) -> None:
        self.rig.todo.append(Publish(topic, message))
        self.runner.run(0.3)


def pose(frame: str, sigma: float, stamp_ns: int = EXPOSED) -> m.PoseWithCovariance:
    covariance = tuple(np.diag(np.full(6, sigma**2)).ravel().tolist())
    return m.PoseWithCovariance(stamp_ns, frame, TIP, UPRIGHT, covariance)


def inserted(insertion: float) -> m.JointState:
    return m.JointState(1, ("insertion_joint",), (insertion,))


def steered() -> Scene:
    """Return a scene with a detected tip, an estimate, a plane and a point."""
    scene = Scene()
    scene.publish("joint_states", inserted(0.04))
    status = ControllerStatus(target_offset_m=0.003, target_point_m=(0.01, 0.0, 0.1))
    scene.publish("needle/controller_status", status)
    scene.publish("needle/tip_pose", pose("rig", 1e-4))
    # In the frame of the plane, offset by 3 mm.
    scene.publish("needle/estimate", pose("target_plane", 2e-4))
    return scene


def shown(markers: m.Markers) -> dict[str, m.Marker]:
    return {marker.namespace: marker for marker in markers.markers if marker.action == ADD}


def test_known_quantities_are_drawn_and_the_others_deleted() -> None:
    scene = Scene()
    received = scene.open_viewer(live_view.MARKERS, live_view.TIP, live_view.PATH).received
    markers = received[live_view.MARKERS]
    status = ControllerStatus(target_offset_m=0.003, target_point_m=(0.01, 0.0, 0.1))
    scene.publish("needle/controller_status", status)
    assert set(shown(markers[-1])) == {"plane", "target_point"}
    assert len(markers[-1].markers) == 6
    scene.publish("joint_states", inserted(0.04))
    scene.publish("needle/tip_pose", pose("rig", 1e-4))
    there = shown(markers[-1])
    assert there["shaft"].points[-1] == TIP
    assert there["uncertainty"].scale == pytest.approx((2 * 2.7955e-4,) * 3)
    assert there["plane"].position[0] == pytest.approx(0.003)
    assert there["plane"].frame_id == "rig"
    assert there["plane"].stamp_ns == pytest.approx(scene.runner.timeline.stamp_ns, abs=2e8)
    assert received[live_view.TIP][-1] == m.Pose(EXPOSED, "rig", TIP, UPRIGHT)
    assert received[live_view.PATH][-1].positions[-1] == TIP
    scene.publish("needle/estimate", pose("target_plane", 2e-4))
    there = shown(markers[-1])
    assert there["estimate"].points[0] == pytest.approx((TIP[0] + 0.003, *TIP[1:]))
    assert there["uncertainty"].scale == pytest.approx((4 * 2.7955e-4,) * 3)
    # A tip that was not found is grey.
    scene.publish("needle/tip_pose", pose("rig", np.inf, 2 * EXPOSED))
    assert shown(markers[-1])["tip"].colour == (0.7, 0.7, 0.7, 1.0)


def test_topics_without_subscriber_are_not_published() -> None:
    scene = steered()
    assert scene.published == []
    scene.open_viewer(live_view.PATH)
    assert {topic for topic, _ in scene.published} == {live_view.PATH}
    scene.runner.stop("viewer")
    scene.runner.run(0.5)
    scene.published.clear()
    scene.runner.run(0.5)
    assert scene.published == []
    # Images are not received either.
    peers, at = Peers(subscribers={LEFT: ("viewer",)}), Moment(0.0, 0)
    assert list(scene.view.on_peers(peers, at)) == [Listen(RAW, True), Listen(RAW_RIGHT, False)]
    assert list(scene.view.on_peers(Peers(), at)) == [Listen(RAW, False), Listen(RAW_RIGHT, False)]
    assert {row.topic for row in scene.view.inputs if row.lazy} == {RAW, RAW_RIGHT}
    # Without the message type for transforms, the topic does not exist.
    topics = {live_view.TIP, live_view.PATH, live_view.MARKERS, *live_view.PICTURES.values()}
    topics.add(live_view.ROBOT_DESCRIPTION)
    assert {row.topic for row in scene.view.outputs} == topics


def test_implausible_messages_are_rejected() -> None:
    scene = steered()
    markers = scene.open_viewer(live_view.MARKERS).received[live_view.MARKERS]
    before = shown(markers[-1])
    for topic, message in (
        ("joint_states", inserted(1e300)),
        ("joint_states", m.JointState(1, ("other_joint",), (0.0,))),
        ("needle/estimate", pose("target_plane", np.nan)),
        ("needle/estimate", pose("target_plane", 1e150)),
        ("needle/controller_status", ControllerStatus(target_offset_m=20.0)),
        ("needle/controller_status", ControllerStatus(target_point_m=(0.0, 0.0, 20.0))),
        ("target_plane", m.Pose(1, "elsewhere", (0.0, 0.0, 0.0), UPRIGHT)),
        ("stereo_tracker/calibration", m.Text("none")),
    ):
        scene.publish(topic, message)
        assert scene.health[topic].startswith("refused: ")
        assert "handlers" not in scene.health
        after = shown(markers[-1])
        assert after["estimate"].points == before["estimate"].points
        assert after["shaft"].points == before["shaft"].points
        assert after.keys() == before.keys()
    # Health recovers with a good message.
    scene.publish("joint_states", inserted(0.04))
    assert scene.health["joint_states"] == "ok"


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
    scene = steered()
    scene.publish("stereo_tracker/calibration", m.Text(CALIBRATION.read_text("utf-8")))
    pictures = scene.open_viewer(LEFT).received[LEFT]
    scene.rig.todo.append(Publish(RAW, black(2 * EXPOSED)))
    scene.publish("needle/tip_pose", pose("rig", 1e-4, 2 * EXPOSED))
    (received,) = pictures
    assert (received.stamp_ns, received.format) == (2 * EXPOSED, "jpeg")
    assert received.frame_id == "left_camera_optical"
    picture = cv2.imdecode(np.frombuffer(received.data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    camera = load_calibration(CALIBRATION).left
    assert picture.shape == (camera.height, camera.width, 3)
    u, v = np.round(left_view(np.array(TIP)))
    ring = picture[int(v) - 12 : int(v) + 13, int(u) - 12 : int(u) + 13]
    # Orange: red over green over blue.
    assert (ring[..., 2].astype(int) - ring[..., 0] > 100).sum() > 20


def test_images_of_another_camera_or_before_a_subscription_are_not_shown() -> None:
    scene = Scene()
    scene.publish("stereo_tracker/calibration", m.Text(CALIBRATION.read_text("utf-8")))
    scene.publish(RAW, black(1))
    first = Viewer(scene.view, [LEFT])
    scene.runner.start(first)
    scene.runner.run(0.25)
    # It still waits for its answer when the viewer leaves.
    scene.rig.todo.append(Publish(RAW, black(2)))
    scene.runner.run(0.05)
    scene.runner.stop("viewer")
    scene.publish(RAW, black(3))
    pictures = scene.open_viewer(LEFT).received[LEFT]
    scene.runner.run(1.0)
    assert pictures == []
    scene.publish(RAW, m.Image(1, "", 2, 3, "mono8", 3, bytes(6)))
    assert "the calibration is for" in scene.health[RAW]
    scene.publish(RAW, black(4))
    scene.runner.run(1.0)
    assert [picture.stamp_ns for picture in pictures] == [4]
    assert first.received[LEFT] == []


# ---- transforms


def test_transforms_are_published_if_the_message_type_is_installed() -> None:
    scene = Scene(transforms=True)
    assert Output(live_view.TF_STATIC, m.Transforms, LATCHED) in scene.view.outputs
    scene.publish("stereo_tracker/calibration", m.Text(CALIBRATION.read_text("utf-8")))
    received = scene.open_viewer(live_view.TF, live_view.TF_STATIC).received
    assert len(received[live_view.TF_STATIC]) == 1
    # Nothing is sent before there is data.
    assert received[live_view.TF] == []
    scene.publish("needle/controller_status", ControllerStatus(target_offset_m=0.003))
    scene.publish("needle/tip_pose", pose("rig", 1e-4))
    plane, tip = received[live_view.TF][-1].transforms
    assert (plane.child_frame_id, plane.translation) == ("target_plane", (0.003, 0.0, 0.0))
    assert tip == m.Transform(EXPOSED, "rig", "needle_tip", TIP, UPRIGHT)


# ---- clients of the port


def test_clients_receive_watched_topics_and_latched_ones_alone(left_view: Projection) -> None:
    scene, clients = Scene(foxglove_port=1), Clients()
    scene.runner.start(clients)
    scene.open_viewer(live_view.PATH)

    def received() -> set[str]:
        clients.received.clear()
        scene.publish("stereo_tracker/calibration", m.Text(CALIBRATION.read_text("utf-8")))
        scene.publish("needle/controller_status", ControllerStatus(target_offset_m=0.003))
        scene.publish("joint_states", inserted(0.04))
        scene.publish("needle/reduced_state", m.Vector(1, "target_plane", TIP))
        scene.rig.todo.append(Publish(RAW, black(EXPOSED)))
        scene.publish("needle/tip_pose", pose("rig", 1e-4))
        return {topic for topic, _, _ in clients.received}

    latched = {"needle/controller_status", live_view.TF_STATIC, live_view.ROBOT_DESCRIPTION}
    assert received() == latched
    watched = {LEFT, "joint_states", "needle/reduced_state", live_view.TF}
    clients.todo.append(Send(FOXGLOVE, (Watched(frozenset(watched)),)))
    scene.runner.run(0.1)
    assert received() == latched | watched
    (state,) = (one for topic, one, _ in clients.received if topic == "needle/reduced_state")
    assert state == m.Vector(1, "target_plane", TIP)
    on_topics = {topic for topic, _ in scene.published}
    assert on_topics == {live_view.ROBOT_DESCRIPTION, live_view.PATH}
    clients.todo.append(Send(FOXGLOVE, (Watched(frozenset()),)))
    scene.runner.run(0.1)
    assert received() == latched
    # Images are also received if only clients of the port request them.
    (port,) = scene.view.ports
    for topics in ({LEFT}, set()):
        actions = list(port.handler([Watched(frozenset(topics))], Moment(0.0, 0)))
        assert actions == [Listen(RAW, LEFT in topics), Listen(RAW_RIGHT, False)]
    # Without the port, unneeded topics are not received.
    plain = Scene().view
    assert plain.ports == ()
    assert "needle/reduced_state" not in {row.topic for row in plain.inputs}
