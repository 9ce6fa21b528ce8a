"""Component `stereo_tracker`: images and joint states in, one answer for every pair out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial

from needle_core import messages as m
from needle_core.component import (
    IMAGES,
    IMAGES_BEST_EFFORT,
    JOINT_STATES,
    LATCHED,
    Actions,
    Component,
    Diagnose,
    Input,
    Log,
    Moment,
    Output,
    Peers,
    Publish,
    Timer,
)
from needle_core.diagnostics import Level
from needle_tracker.answers.annotation import annotate
from needle_tracker.answers.health import Health
from needle_tracker.answers.pair_answers import Answer, PairAnswers
from needle_tracker.answers.tracker_messages import (
    camera_info_problem,
    frame_of,
    insertion_of,
    picture_message,
    tip_message,
    tip_pose_message,
)
from needle_tracker.filter.measurement import TrackState
from needle_tracker.optics.calibration import SIDES, StereoCalibration, load_calibration
from needle_tracker.tracker_parameters import StereoTrackerParameters

TIP, TIP_POSE = "needle/tip", "needle/tip_pose"
ANNOTATED, CALIBRATION = "stereo_tracker/annotated_image", "stereo_tracker/calibration"
_CHECK_PERIOD = 0.05  # [s]


class StereoTipTracker(Component):
    """Measures the tip of the needle in each stereo pair, and publishes tips and diagnostics.

    Parameters
    ----------
    settings : StereoTrackerParameters
        Parameters of the node.
    calibration : StereoCalibration
        The stereo rig; the text of its file is published for recorders.
    name : str
        Full name of the node.

    Attributes
    ----------
    answers : PairAnswers
        Core of the node.
    has_annotation_subscriber : bool
        Whether the annotated images have a subscriber.
    """

    name = "stereo_tracker"

    def __init__(
        self, settings: StereoTrackerParameters, calibration: StereoCalibration, name: str = name
    ) -> None:
        self.name, self.settings = name, settings
        self.has_annotation_subscriber = False
        self._cameras = calibration.cameras
        self._calibration_text = calibration.text
        self._is_calibration_published = False
        self.answers = PairAnswers(calibration, settings)
        self._health = Health(self.answers)
        rate = settings.annotated_rate
        self._annotated_period = 1.0 / rate if rate > 0.0 else math.inf
        self._annotated_at = -math.inf
        # The states at startup are not logged.
        self._reported = {"track": TrackState.SEARCHING.value, "images": "no images yet"}
        joints = Input("joint_states", m.JointState, self._on_joints, JOINT_STATES)
        self.inputs = (joints, *self._image_rows())
        self.outputs = (
            Output(TIP, m.Point),
            Output(TIP_POSE, m.PoseWithCovariance),
            Output(ANNOTATED, m.Image, IMAGES),
            Output(CALIBRATION, m.Text, LATCHED),
        )
        self.timers = (Timer(_CHECK_PERIOD, self.check),)

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Record whether the annotated images have a subscriber."""
        self.has_annotation_subscriber = ANNOTATED in peers.subscribers
        return ()

    def check(self, at: Moment) -> Actions:
        """Answer the pairs that waited for their joint state until the timeout."""
        if not self._is_calibration_published:
            self._is_calibration_published = True
            yield Publish(CALIBRATION, m.Text(self._calibration_text))
        yield from self.publish(self.answers.ready(at.steady), at)
        yield from self._report(at)

    def publish(self, answers: Iterable[Answer], at: Moment) -> Actions:
        """Return the messages of answers, in the order of sending."""
        for answer in answers:
            stamp_ns, tip = answer.pair.stamp, answer.measured.tip
            if tip is not None:
                yield Publish(TIP, tip_message(tip, stamp_ns))
            yield Publish(TIP_POSE, tip_pose_message(tip, stamp_ns))
            yield from self._annotate(answer, at)
            self._health.add_pair(answer, at.steady)
            yield from self._report(at)

    # ---- inputs -------------------------------------------------------------------------------

    def _image_rows(self) -> list[Input]:
        delivery = IMAGES if self.settings.reliable_images else IMAGES_BEST_EFFORT
        rows = []
        for side in SIDES:
            on_image, on_info = partial(self._on_image, side), partial(self._on_camera_info, side)
            rows.append(Input(f"stereo/{side}/image_raw", m.Image, on_image, delivery))
            rows.append(Input(f"stereo/{side}/camera_info", m.CameraInfo, on_info, delivery))
        return rows

    def _on_joints(self, message: m.JointState, at: Moment) -> Actions:
        insertion = insertion_of(message)
        if insertion is None:
            self._health.joints_without_insertion += 1
            return ()
        answers = self.answers.add_insertion(message.stamp_ns, insertion, at.steady)
        return self.publish(answers, at)

    def _on_image(self, side: str, message: m.Image, at: Moment) -> Actions:
        self._health.add_image(side, at.steady)
        frame = frame_of(message, side, self._cameras[side])
        answers = self.answers.add_image(side, message.stamp_ns, frame, at.steady)
        return self.publish(answers, at)

    def _on_camera_info(self, side: str, message: m.CameraInfo, at: Moment) -> Actions:
        problem = camera_info_problem(message, side, self._cameras[side])
        self.answers.camera_info[side] = problem
        return ()

    # ---- outputs ------------------------------------------------------------------------------

    def _annotate(self, answer: Answer, at: Moment) -> Actions:
        left, right = answer.pair.left.pixels, answer.pair.right.pixels
        due = at.steady - self._annotated_at >= self._annotated_period
        if self.has_annotation_subscriber and due and left is not None and right is not None:
            self._annotated_at = at.steady
            picture = annotate(left, right, answer.measured)
            yield Publish(ANNOTATED, picture_message(picture, answer.pair.stamp))

    def _report(self, at: Moment) -> Actions:
        """Publish the diagnostics of all parts; log a part when it turns bad."""
        for part, diagnostic in self._health.parts(at.steady).items():
            yield Diagnose(part, diagnostic)
            kind = diagnostic.message.partition(":")[0]
            if kind != self._reported.get(part) and diagnostic.level >= Level.WARN:
                yield Log("warning", f"{part}: {diagnostic.message}")
            self._reported[part] = kind


def make_tracker(
    settings: StereoTrackerParameters, name: str = "stereo_tracker"
) -> StereoTipTracker:
    """Return the tracker with the calibration of its settings, the installed one by default.

    Raises
    ------
    UserError
        A bad calibration file.
    """
    return StereoTipTracker(settings, load_calibration(settings.calibration_file), name)
