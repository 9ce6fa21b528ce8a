"""live_view as a component: the needle as messages for ROS viewers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from needle_bags.live.camera_images import LatestImages, draw_needle
from needle_bags.live.live_messages import (
    camera_frame,
    camera_transforms,
    to_markers,
    to_path,
    to_tip,
    to_transforms,
)
from needle_bags.live.live_needle import LiveNeedle
from needle_bags.live.needle_inputs import needle_inputs, rejecting
from needle_core import messages as m
from needle_core.component import (
    IMAGES_BEST_EFFORT,
    LATCHED,
    Actions,
    Component,
    Input,
    Listen,
    Moment,
    Output,
    Peers,
    Publish,
    Timer,
)
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_tracker.answers.tracker_messages import frame_of
from needle_tracker.optics.calibration import SIDES, calibration_from
from needle_tracker.optics.refraction import RefractedCamera, stereo_views

TIP, PATH, MARKERS = "live_view/tip", "live_view/path", "live_view/markers"
PICTURES = {side: f"live_view/{side}/compressed" for side in SIDES}
TF, TF_STATIC = "/tf", "/tf_static"
_IMAGES = {side: f"stereo/{side}/image_raw" for side in SIDES}
_CALIBRATION = "stereo_tracker/calibration"


@dataclasses.dataclass(frozen=True)
class LiveViewParameters:
    """Parameters of live_view."""

    rate: float = fixed_parameter(
        10.0, "Hz", "Maximum rate of each message, images included.", 0.5, 30.0
    )

    def __post_init__(self) -> None:
        """Check the fields; raises UserError as `check_fields`."""
        check_fields(self)


class LiveView(Component):
    """Publishes a `LiveNeedle`, each topic only while it has a subscriber.

    Parameters
    ----------
    settings : LiveViewParameters
        The node's parameters.
    transforms : bool
        Whether to publish /tf and /tf_static.
    """

    name = "live_view"
    accepts_simulated_time = True

    def __init__(self, settings: LiveViewParameters, *, transforms: bool) -> None:
        self.settings = settings
        self._needle = needle = LiveNeedle()
        self._images = {side: LatestImages() for side in SIDES}
        self._cameras: dict[str, RefractedCamera] = {}
        self._peers = Peers()
        self._transforms = transforms
        rows: list[tuple[str, type[Any], Callable[[Moment], Any]]] = [
            (TIP, m.Pose, lambda at: needle.tip and to_tip(needle.tip)),
            (PATH, m.Path, lambda at: to_path(needle.path, at.stamp_ns)),
            (MARKERS, m.Markers, lambda at: to_markers(needle, at.stamp_ns)),
            *(
                (topic, m.CompressedImage, partial(self._picture, s))
                for s, topic in PICTURES.items()
            ),
        ]
        if transforms:
            rows.append((TF, m.Transforms, lambda at: to_transforms(needle, at.stamp_ns)))
        self._makers = {topic: make for topic, _, make in rows}
        self.inputs = (
            *needle_inputs(needle),
            rejecting(Input(_CALIBRATION, m.Text, self._on_calibration, LATCHED)),
            *(
                rejecting(
                    Input(topic, m.Image, partial(self._on_image, s), IMAGES_BEST_EFFORT, lazy=True)
                )
                for s, topic in _IMAGES.items()
            ),
        )
        self.outputs = tuple(Output(topic, kind) for topic, kind, _ in rows)
        if transforms:
            self.outputs += (Output(TF_STATIC, m.Transforms, LATCHED),)
        self.timers = (Timer(1.0 / settings.rate, self._publish),)

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note the subscribers; receive images only while they are displayed."""
        self._peers = peers
        for side in SIDES:
            is_displayed = PICTURES[side] in peers.subscribers
            if not is_displayed:
                self._images[side] = LatestImages()
            yield Listen(_IMAGES[side], is_displayed)

    def _on_calibration(self, message: m.Text, at: Moment) -> Actions:
        views = stereo_views(calibration_from(message.text, Path(_CALIBRATION)))
        self._cameras = dict(zip(SIDES, views, strict=True))
        if self._transforms:
            yield Publish(TF_STATIC, camera_transforms(self._cameras, at.stamp_ns))

    def _on_image(self, side: str, message: m.Image, at: Moment) -> Actions:
        if side in self._cameras and PICTURES[side] in self._peers.subscribers:
            frame = frame_of(message, side, self._cameras[side].camera)
            if frame.pixels is None:
                raise UserError(frame.problem)
            self._images[side].add(message.stamp_ns, frame.pixels)
        return ()

    def _publish(self, at: Moment) -> Actions:
        for topic, make in self._makers.items():
            if topic in self._peers.subscribers and (message := make(at)) is not None:
                yield Publish(topic, message)

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
