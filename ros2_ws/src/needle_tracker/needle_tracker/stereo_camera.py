"""Component `stereo_camera`: publishes the image pairs of a source with their calibration."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from collections.abc import Sequence

import numpy as np

from needle_core import messages as m
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE
from needle_core.component import (
    IMAGES,
    Actions,
    Component,
    Diagnose,
    Exit,
    Log,
    Moment,
    Output,
    Peers,
    Port,
    PortChange,
    Publish,
    Send,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_tracker.optics.calibration import SIDES, Camera, StereoCalibration, load_calibration
from needle_tracker.sources.stereo_source import (
    EndOfRecording,
    Event,
    PairPort,
    StampedPair,
    open_source,
)

PAIRS = "pairs"
_WINDOW = 5.0  # over which the rate is measured [s]


@dataclasses.dataclass(frozen=True)
class StereoCameraParameters:
    """Parameters of the node, fixed at start."""

    left: str = fixed_parameter(
        "", "-", "Left source: device number, /dev/..., folder of images, or video file."
    )
    right: str = fixed_parameter("", "-", "Right source, of the same kind as the left.")
    calibration_file: str = fixed_parameter(
        "", "-", "Calibration file of the stereo rig; empty: the simulated bench's."
    )
    rate: float = fixed_parameter(20.0, "Hz", "Rate of image pairs.", 0.1, 1000.0)
    loop: bool = fixed_parameter(False, "-", "Repeat a recording, instead of exiting at its end.")
    latency: float = fixed_parameter(
        0.0, "s", "Time from exposure to grab, subtracted from the stamp (cameras only).", 0.0, 1.0
    )
    triggered: bool = fixed_parameter(
        False, "-", "One trigger exposes both cameras: both images get the left image's stamp."
    )
    wait_for_subscribers: bool = fixed_parameter(
        False, "-", "Start when both image topics have a subscriber (for recordings)."
    )

    def __post_init__(self) -> None:
        """Check the fields."""
        check_fields(self)


class StereoCamera(Component):
    """Requests a pair at each tick, and publishes the received pairs.

    Parameters
    ----------
    settings : StereoCameraParameters
        Parameters of the node.
    calibration : StereoCalibration
        The cameras.
    name : str
        Full name of the node.
    """

    name = "stereo_camera"
    outputs = tuple(
        Output(f"stereo/{side}/{topic}", message, IMAGES)
        for side in SIDES
        for topic, message in (("image_raw", m.Image), ("camera_info", m.CameraInfo))
    )

    def __init__(
        self, settings: StereoCameraParameters, calibration: StereoCalibration, name: str = name
    ) -> None:
        self.name, self.settings = name, settings
        self._infos = {side: _camera_info(c, side) for side, c in calibration.cameras.items()}
        self._has_begun = not settings.wait_for_subscribers
        # Whether a tick has made a request due, and whether a requested pair is outstanding.
        self._is_due = self._is_pending = False
        self._started_at = math.inf
        # Times of publication of the latest pairs [s].
        self._times: deque[float] = deque(maxlen=round(_WINDOW * settings.rate) + 1)
        self._pairs = self._dropped = self._skew_ns = 0
        self.ports = (Port(PAIRS, self._on_pairs, self._on_change),)
        self.timers = (Timer(1.0 / settings.rate, self._tick), Timer(0.5, self._report))

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Begin when both images have a subscriber."""
        topics = [f"stereo/{side}/image_raw" for side in SIDES]
        self._has_begun |= all(topic in peers.subscribers for topic in topics)
        return ()

    def _tick(self, at: Moment) -> Actions:
        if self._started_at == math.inf:
            self._started_at = at.steady
            yield Log("info", f"publishes images at {self.settings.rate:g} Hz")
        self._is_due = self._has_begun
        yield from self._request()

    def _request(self) -> Actions:
        """Request the pair that is due, as soon as the previous one was received."""
        if self._is_due and not self._is_pending:
            self._is_due, self._is_pending = False, True
            yield Send(PAIRS, ("next",))

    def _on_pairs(self, events: Sequence[Event], at: Moment) -> Actions:
        for event in events:
            self._is_pending = False
            match event:
                case StampedPair():
                    yield from self._publish(event, at)
                case EndOfRecording(missing):
                    counts = f"{self._pairs} pairs, {self._dropped} unreadable"
                    yield Log("info", f"end of the recording: {counts}")
                    if missing:
                        yield Log("warning", f"the recording is incomplete: {missing}")
                    yield Exit(EXIT_DONE)
                    return
                case None:
                    self._dropped += 1
                    yield Log("warning", "a pair could not be read", kind="unreadable")
        yield from self._request()

    def _on_change(self, change: PortChange, at: Moment) -> Actions:
        yield Exit(EXIT_BAD_INPUT, change.lost)

    def _publish(self, pair: StampedPair, at: Moment) -> Actions:
        latency_ns = round(1e9 * self.settings.latency)
        left_ns, right_ns = pair.left_stamp - latency_ns, pair.right_stamp - latency_ns
        self._skew_ns = max(self._skew_ns, abs(right_ns - left_ns))
        if self.settings.triggered:
            right_ns = left_ns
        views = ("left", pair.left, left_ns), ("right", pair.right, right_ns)
        for side, pixels, stamp_ns in views:
            info = dataclasses.replace(self._infos[side], stamp_ns=stamp_ns)
            yield Publish(f"stereo/{side}/camera_info", info)
            height, width = pixels.shape
            # A view of contiguous pixels, not a copy.
            data = pixels.reshape(-1).data
            image = m.Image(stamp_ns, info.frame_id, height, width, "mono8", width, data)
            yield Publish(f"stereo/{side}/image_raw", image)
        self._pairs += 1
        self._times.append(at.steady)

    def _report(self, at: Moment) -> Actions:
        requested, recent = self.settings.rate, [t for t in self._times if at.steady - t <= _WINDOW]
        rate = (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0
        values = {
            "pairs": str(self._pairs),
            "rate_hz": f"{rate:.1f}",
            "dropped": str(self._dropped),
            "skew_max_ms": f"{1e-6 * self._skew_ns:.2f}",
        }
        level, message = Level.OK, "images published"
        if not self._has_begun:
            level, message = Level.WARN, "waiting for subscribers"
        elif self._dropped:
            level, message = Level.WARN, "some pairs could not be read"
        elif at.steady - self._started_at > 3.0 and rate < 0.8 * requested:
            level, message = Level.WARN, f"slower than the {requested:g} Hz requested"
        yield Diagnose("images", Diagnostic(level, message, values))


def make_camera(settings: StereoCameraParameters, name: str = StereoCamera.name) -> StereoCamera:
    """Return the component with the calibration of its settings.

    Raises
    ------
    UserError
        A bad calibration file.
    """
    return StereoCamera(settings, load_calibration(settings.calibration_file), name)


def open_pairs(settings: StereoCameraParameters) -> PairPort:
    """Return the port `pairs` of an open source, which stamps images with the wall clock.

    Raises
    ------
    UserError
        A bad source.
    """
    sizes = load_calibration(settings.calibration_file).sizes
    names = settings.left, settings.right
    return PairPort(open_source(names, sizes, settings.rate, time.time_ns, loop=settings.loop))


def _camera_info(camera: Camera, side: str) -> m.CameraInfo:
    matrix = camera.camera_matrix
    return m.CameraInfo(
        0,
        f"{side}_camera_optical",
        camera.height,
        camera.width,
        "plumb_bob",
        tuple(camera.distortion.tolist()),
        tuple(matrix.ravel().tolist()),
        tuple(np.eye(3).ravel().tolist()),
        tuple(np.hstack([matrix, np.zeros((3, 1))]).ravel().tolist()),
    )
