"""ROS shell of the stereo tracker: images and joint states in, one answer for every pair out."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections import Counter, deque
from pathlib import Path
from typing import Any

import numpy as np
from ament_index_python.packages import get_package_share_directory
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, JointState

from needle_common.base_node import STEADY_CLOCK, DiagnosticsPublisher, run_node
from needle_common.conversions import (
    IMAGES,
    IMAGES_BEST_EFFORT,
    JOINT_STATES,
    LATCHED,
    RELIABLE,
    to_nanoseconds,
)
from needle_common.diagnostics import Diagnostic, Level
from needle_common.parameters import NodeParameters
from needle_tracker.annotation import annotate
from needle_tracker.calibration import SIDES, load_calibration
from needle_tracker.conversions import (
    Frame,
    camera_info_problem,
    insertion_of,
    roll_sigma_of,
    rotation_of,
    to_frame,
    to_image,
    to_tip,
    to_tip_pose,
)
from needle_tracker.health import Health
from needle_tracker.insertion_history import InsertionHistory
from needle_tracker.pairing import Pair, PairMatcher
from needle_tracker.parameters import StereoTrackerParameters
from needle_tracker.pre_bend import heading_of
from needle_tracker.track import TrackState
from needle_tracker.tracker import Measurement, StereoTracker
from needle_tracker.triangulation import SpatialTip

HELP = """
stereo_tracker: where the needle's tip is, from stereo images through the phantom's surface.

Subscribes: stereo/{left,right}/image_raw, stereo/{left,right}/camera_info, joint_states.
Publishes: needle/tip (only where a tip was found), needle/tip_pose (one for every image pair; an
infinite covariance says that no tip was found), /diagnostics, ~/annotated_image (while someone
subscribes).
"""
_NEW_RECORDING = 1_000_000_000  # [ns]: a longer step back in time begins a new recording
_ROLL_AGE = 5_000_000_000  # [ns]
_ROLL_SIGMA = 0.6  # a roll known worse than that takes no lean off [rad]
_CHECK_PERIOD = 0.05  # [s]


@dataclasses.dataclass(frozen=True)
class RollEstimate:
    """What the controller last said: stamp [ns], axes of the tip's frame in `rig`, sigma [rad]."""

    stamp: int
    rotation: NDArray[np.float64]
    sigma: float


class StereoTrackerNode(Node):
    """Pairs images by stamp, joins the insertion at that stamp, answers every pair in order.

    Parameters
    ----------
    **kwargs
        Passed on to `rclpy.node.Node`.

    Raises
    ------
    UserError
        A bad parameter or calibration file.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("stereo_tracker", **kwargs)
        parameters = NodeParameters(self, StereoTrackerParameters).values
        path = parameters.calibration_file
        default = Path(get_package_share_directory("needle_tracker"), "config", "calibration.yaml")
        calibration = load_calibration(Path(path) if path else default)
        self._cameras = {"left": calibration.left, "right": calibration.right}
        self._tracker = StereoTracker(calibration, parameters.tracker_settings(calibration.phantom))
        self._tracker.warm_up()
        self._lean = parameters.lean
        self._roll: RollEstimate | None = None
        self._T_rig_plane = np.eye(3)
        rate = parameters.annotated_rate
        self._annotated_period = 1.0 / rate if rate > 0.0 else math.inf
        self._annotated_at = -math.inf
        self._joint_timeout = parameters.joint_timeout
        self._matcher: PairMatcher[Frame] = PairMatcher(parameters.pair_tolerance_ns)
        self._queue: deque[tuple[float, Pair[Frame]]] = deque()
        self._insertions = InsertionHistory()
        self._joints_silent = False
        self._last_stamp: int | None = None
        self._health = Health(Counter(), Counter())
        # What every start begins with is not worth a warning in the log.
        self._told = {"track": TrackState.SEARCHING.value, "images": "no images yet"}

        self._tip = self.create_publisher(PointStamped, "needle/tip", RELIABLE)
        self._tip_pose = self.create_publisher(
            PoseWithCovarianceStamped, "needle/tip_pose", RELIABLE
        )
        self._annotated = self.create_publisher(Image, "~/annotated_image", IMAGES)
        self._diagnostics = DiagnosticsPublisher(self)
        if parameters.heading_from_estimate:
            self.create_subscription(
                PoseWithCovarianceStamped, "needle/estimate", self._on_estimate, RELIABLE
            )
            self.create_subscription(PoseStamped, "target_plane", self._on_target, LATCHED)
        self.create_subscription(JointState, "joint_states", self._on_joints, JOINT_STATES)
        quality = IMAGES if parameters.reliable_images else IMAGES_BEST_EFFORT
        for side in SIDES:
            self.create_subscription(
                Image,
                f"stereo/{side}/image_raw",
                lambda message, side=side: self._on_image(side, message),
                quality,
            )
            self.create_subscription(
                CameraInfo,
                f"stereo/{side}/camera_info",
                lambda message, side=side: self._on_camera_info(side, message),
                quality,
            )
        self.create_timer(_CHECK_PERIOD, self._check, clock=STEADY_CLOCK)
        self._report()

    def _on_camera_info(self, side: str, message: CameraInfo) -> None:
        problem = camera_info_problem(message, side, self._cameras[side])
        self._health.camera_info[side] = problem

    def _on_joints(self, message: JointState) -> None:
        insertion = insertion_of(message)
        if insertion is None:
            self._health.joints_without_insertion += 1
            return
        self._joints_silent = False
        self._insertions.add(to_nanoseconds(message.header.stamp), insertion)
        self._answer_ready()

    def _on_image(self, side: str, message: Image) -> None:
        now = time.monotonic()
        stamp = to_nanoseconds(message.header.stamp)
        self._health.image_came(side, now)
        pair = self._matcher.add(side, stamp, to_frame(message, side, self._cameras[side]))
        if pair is not None:
            self._queue.append((now, pair))
            self._answer_ready()

    def _check(self) -> None:
        self._answer_ready()
        self._report()

    def _answer_ready(self) -> None:
        """Answer, in order, all pairs whose insertion is settled."""
        while self._queue:
            arrival, pair = self._queue[0]
            if not (self._joints_silent or self._insertions.is_bracketed(pair.stamp)):
                if time.monotonic() - arrival < self._joint_timeout:
                    return
                self._joints_silent = True
            self._queue.popleft()
            measured = self._measure(pair)
            tip = measured.tip
            if tip is not None:
                self._tip.publish(to_tip(tip, pair.stamp))
                tip = self._with_heading(tip, pair.stamp)
            self._tip_pose.publish(to_tip_pose(tip, pair.stamp))
            self._annotate(pair, measured)
            self._health.pair_done(arrival, time.monotonic(), measured)
            self._report()

    def _measure(self, pair: Pair[Frame]) -> Measurement:
        last = self._last_stamp
        problem = pair.left.problem or pair.right.problem
        if last is not None and pair.stamp <= last:
            back = last - pair.stamp
            problem = "time of exposure ran backwards" if back else "time of exposure repeated"
            if back >= _NEW_RECORDING:
                self._tracker.reset()
                self._last_stamp = pair.stamp
        else:
            self._last_stamp = pair.stamp
        left, right = pair.left.pixels, pair.right.pixels
        if problem or left is None or right is None:
            self._health.refused[problem] += 1
            self._health.last_refusal = (time.monotonic(), problem)
            return self._tracker.skip(problem)
        return self._tracker.process(left, right, self._insertions.at(pair.stamp))

    def _on_estimate(self, message: PoseWithCovarianceStamped) -> None:
        rotation = rotation_of(message.pose.pose)
        if rotation is None:
            return
        sigma = roll_sigma_of(message.pose.covariance, rotation[:, 2])
        stamp = to_nanoseconds(message.header.stamp)
        self._roll = RollEstimate(stamp, self._T_rig_plane @ rotation, sigma)

    def _on_target(self, message: PoseStamped) -> None:
        rotation = rotation_of(message.pose)
        if rotation is not None:
            self._T_rig_plane = rotation

    def _with_heading(self, tip: SpatialTip, stamp: int) -> SpatialTip:
        """Return the tip with its heading in the visible end's place, where the roll is known."""
        roll = self._roll
        if roll is None or abs(stamp - roll.stamp) > _ROLL_AGE or not roll.sigma < _ROLL_SIGMA:
            return tip
        heading, covariance = heading_of(
            tip.direction, tip.direction_covariance, roll.rotation, roll.sigma, self._lean
        )
        return dataclasses.replace(tip, direction=heading, direction_covariance=covariance)

    def _annotate(self, pair: Pair[Frame], measured: Measurement) -> None:
        now = time.monotonic()
        left, right = pair.left.pixels, pair.right.pixels
        due = now - self._annotated_at >= self._annotated_period
        if not due or left is None or right is None:
            return
        if self._annotated.get_subscription_count() == 0:
            return
        self._annotated_at = now
        self._annotated.publish(to_image(annotate(left, right, measured), pair.stamp))

    def _report(self) -> None:
        now = time.monotonic()
        self._health.note_pairing(now, self._matcher)
        self._tell("track", self._health.track())
        self._tell("images", self._health.images(now, self._matcher))
        self._tell("joints", self._health.joints(self._insertions, self._joints_silent))

    def _tell(self, part: str, diagnostic: Diagnostic) -> None:
        """Publish a part's health; log it where it turns bad, not each time it still is."""
        self._diagnostics.set(part, diagnostic)
        kind = diagnostic.message.partition(":")[0]
        if kind != self._told.get(part) and diagnostic.level >= Level.WARN:
            self.get_logger().warning(f"{part}: {diagnostic.message}")
        self._told[part] = kind


def main() -> int:
    """Run the node."""
    return run_node(StereoTrackerNode, help_text=HELP, parameters=StereoTrackerParameters)


if __name__ == "__main__":
    sys.exit(main())
