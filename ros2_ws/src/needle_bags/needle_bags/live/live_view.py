"""live_view as a component: the needle as messages for ROS viewers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from needle_bags.live.camera_images import LatestImages, draw_needle
from needle_bags.live.live_messages import (
    camera_frame,
    fixed_transforms,
    to_markers,
    to_path,
    to_tip,
    to_transforms,
)
from needle_bags.live.live_needle import LiveNeedle
from needle_bags.live.needle_inputs import needle_inputs, rejecting
from needle_bags.live.rig_model import camera_bodies, rig_urdf
from needle_core import messages as m
from needle_core.component import (
    IMAGES_BEST_EFFORT,
    LATCHED,
    RELIABLE,
    Actions,
    Component,
    Input,
    Listen,
    Log,
    Moment,
    Output,
    Peers,
    Port,
    Publish,
    Send,
    Timer,
)
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_core.status_messages import DeviceStatus
from needle_device_driver.supervisor.limits import SafetyLimits, limit_parameter
from needle_tracker.answers.tracker_messages import frame_of
from needle_tracker.optics.calibration import SIDES, calibration_from
from needle_tracker.optics.refraction import RefractedCamera, stereo_views

TIP, PATH, MARKERS = "live_view/tip", "live_view/path", "live_view/markers"
PICTURES = {side: f"live_view/{side}/compressed" for side in SIDES}
TF, TF_STATIC = "/tf", "/tf_static"
ROBOT_DESCRIPTION = "robot_description"
FOXGLOVE = "foxglove"
"""Name of the port."""
_IMAGES = {side: f"stereo/{side}/image_raw" for side in SIDES}
_CALIBRATION = "stereo_tracker/calibration"
# Topics that live_view receives only to forward them to Foxglove.
_FORWARDED = (
    ("needle/reduced_state", m.Vector, RELIABLE),
    ("needle/control_input", m.Vector, RELIABLE),
    ("device/status", DeviceStatus, LATCHED),
    ("obstacles", m.Markers, LATCHED),
    ("/diagnostics", m.Diagnostics, RELIABLE),
)


@dataclasses.dataclass(frozen=True)
class LiveViewParameters:
    """Parameters of live_view."""

    rate: float = fixed_parameter(
        10.0, "Hz", "Maximum rate of each message, images included.", 0.5, 30.0
    )
    foxglove_port: int = fixed_parameter(
        0, "-", "Port on loopback for Foxglove, usually 8765; 0: none.", 0, 65535
    )
    needle_diameter: float = fixed_parameter(
        0.7e-3, "m", "Diameter of the needle in robot_description.", 0.2e-3, 3e-3
    )
    max_depth: float = limit_parameter("max_depth")
    max_speed: float = limit_parameter("max_speed")
    max_rotation_rate: float = limit_parameter("max_rotation_rate")
    max_turns: float = limit_parameter("max_turns")

    def __post_init__(self) -> None:
        """Check the fields; raise a `UserError` like `check_fields`."""
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class Watched:
    """Topics that clients of the port display."""

    topics: frozenset[str]


class LiveView(Component):
    """Publishes a `LiveNeedle`, each topic only while it has a subscriber or a client.

    Parameters
    ----------
    settings : LiveViewParameters
        The node's parameters.
    transforms : bool
        Whether to publish /tf and /tf_static; clients receive them in any case.

    Attributes
    ----------
    channels : tuple of Output
        Topics that the port offers to clients; latched ones are always sent.
    """

    name = "live_view"
    accepts_simulated_time = True

    def __init__(self, settings: LiveViewParameters, *, transforms: bool) -> None:
        self.settings = settings
        self._needle = needle = LiveNeedle()
        self._images = {side: LatestImages() for side in SIDES}
        self._cameras: dict[str, RefractedCamera] = {}
        self._peers = Peers()
        self._watched: frozenset[str] = frozenset()
        rows: list[tuple[str, type[Any], Callable[[Moment], Any]]] = [
            (TIP, m.Pose, lambda at: needle.tip and to_tip(needle.tip)),
            (PATH, m.Path, lambda at: to_path(needle.path, at.stamp_ns)),
            (MARKERS, m.Markers, lambda at: to_markers(needle, at.stamp_ns)),
            *(
                (topic, m.CompressedImage, partial(self._picture, s))
                for s, topic in PICTURES.items()
            ),
            (TF, m.Transforms, lambda at: to_transforms(needle, at.stamp_ns)),
        ]
        self._makers = {topic: make for topic, _, make in rows}
        shown = (
            *(Output(topic, kind) for topic, kind, _ in rows),
            Output(TF_STATIC, m.Transforms, LATCHED),
            Output(ROBOT_DESCRIPTION, m.Text, LATCHED),
        )
        self.outputs = tuple(row for row in shown if transforms or row.message != m.Transforms)
        self.inputs = needle_inputs(needle)
        if settings.foxglove_port:
            self.ports = (Port(FOXGLOVE, self._on_clients),)
            more = (Input(topic, kind, _ignore, how) for topic, kind, how in _FORWARDED)
            self.inputs = tuple(map(self._forwarding, (*self.inputs, *more)))
        self.channels = (
            *shown,
            *(Output(row.topic, row.message, row.delivery) for row in self.inputs),
        )
        self.inputs += (
            rejecting(Input(_CALIBRATION, m.Text, self._on_calibration, LATCHED)),
            *(
                rejecting(
                    Input(topic, m.Image, partial(self._on_image, s), IMAGES_BEST_EFFORT, lazy=True)
                )
                for s, topic in _IMAGES.items()
            ),
        )
        self.timers = (Timer(1.0 / settings.rate, self._publish),)

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Store the peers, and subscribe to images only while they are displayed."""
        self._peers = peers
        for side in SIDES:
            is_displayed = self._is_displayed(PICTURES[side])
            if not is_displayed:
                self._images[side] = LatestImages()
            yield Listen(_IMAGES[side], is_displayed)

    def _on_clients(self, events: Sequence[Log | Watched], at: Moment) -> Actions:
        for event in events:
            match event:
                case Log():
                    yield event
                case Watched(topics):
                    self._watched = topics
                    yield from self.on_peers(self._peers, at)

    def _is_displayed(self, topic: str) -> bool:
        return topic in self._peers.subscribers or topic in self._watched

    def _show(self, topic: str, message: Any, at: Moment, *, latched: bool = False) -> Actions:
        """Publish a message, and send it to the clients."""
        is_output = any(row.topic == topic for row in self.outputs)
        if is_output and (latched or topic in self._peers.subscribers):
            yield Publish(topic, message)
        if self.ports and (latched or topic in self._watched):
            yield Send(FOXGLOVE, ((topic, message, at.stamp_ns),))

    def _forwarding(self, row: Input) -> Input:
        """Return an input that also sends its messages to the clients."""

        def handle(message: Any, at: Moment) -> Actions:
            yield from row.handler(message, at)
            if row.delivery.latched or row.topic in self._watched:
                yield Send(FOXGLOVE, ((row.topic, message, at.stamp_ns),))

        return dataclasses.replace(row, handler=handle)

    def _on_calibration(self, message: m.Text, at: Moment) -> Actions:
        calibration = calibration_from(message.text, Path(_CALIBRATION))
        views = stereo_views(calibration)
        self._cameras = dict(zip(SIDES, views, strict=True))
        urdf = rig_urdf(calibration, SafetyLimits.of(self.settings), self.settings.needle_diameter)
        fixed = fixed_transforms(camera_bodies(calibration), at.stamp_ns)
        yield from self._show(ROBOT_DESCRIPTION, m.Text(urdf), at, latched=True)
        yield from self._show(TF_STATIC, fixed, at, latched=True)

    def _on_image(self, side: str, message: m.Image, at: Moment) -> Actions:
        if side in self._cameras and self._is_displayed(PICTURES[side]):
            frame = frame_of(message, side, self._cameras[side].camera)
            if frame.pixels is None:
                raise UserError(frame.problem)
            self._images[side].add(message.stamp_ns, frame.pixels)
        return ()

    def _publish(self, at: Moment) -> Actions:
        for topic, make in self._makers.items():
            if self._is_displayed(topic) and (message := make(at)) is not None:
                yield from self._show(topic, message, at)

    def _picture(self, side: str, at: Moment) -> m.CompressedImage | None:
        found = self._images[side].next(self._needle.answered_ns, at.steady)
        if found is None:
            return None
        stamp_ns, answered, image = found
        shaft, note = np.empty((0, 2)), "no answer from the tracker"
        if answered:
            note = "tip found" if self._needle.tip_found else "no tip found"
        if answered and self._needle.tip_found and self._needle.shaft is not None:
            shaft = self._cameras[side].project(self._needle.shaft)
        data = draw_needle(image, shaft, f"{side}: {note}")
        return m.CompressedImage(stamp_ns, camera_frame(side), "jpeg", data)


def _ignore(message: Any, at: Moment) -> Actions:
    return ()
