"""`ros2 run needle_tracker check_calibration`: whether the calibration is still the rig's."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Sequence

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Image

from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command, write_json
from needle_core.errors import UserError
from needle_core.message_types import to_nanoseconds
from needle_core.process.discovery import restrict_discovery
from needle_core.process.shared_memory import remove_incomplete_ports
from needle_core.ros.base_node import IMAGES_BEST_EFFORT, WholeNode
from needle_tracker.answers.pair_answers import Frame
from needle_tracker.answers.tracker_messages import frame_of
from needle_tracker.calibrating.board_views import averaged_view, views_in_folders
from needle_tracker.calibrating.calibration_check import check
from needle_tracker.calibrating.calibration_session import Session, load_session
from needle_tracker.calibrating.check_options import figures, parse, report
from needle_tracker.calibrating.rig_model import BoardView
from needle_tracker.optics.calibration import SIDES, StereoCalibration, load_calibration
from needle_tracker.sources.image_files import size_problem
from needle_tracker.sources.pairing import PairMatcher


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = list(sys.argv if arguments is None else ["check_calibration", *arguments])
    return run_command(lambda: check_calibration(parse(remove_ros_args(words)[1:]), words))


def check_calibration(options: Namespace, words: list[str]) -> int:
    """Check as asked, print and write the result."""
    calibration, session = load_calibration(options.calibration), load_session(options.session)
    if options.left is not None and options.right is not None:
        views, sizes = views_in_folders(options.left, options.right, session, all_places=False)
        for side, wanted in calibration.sizes.items():
            if problem := size_problem(side, sizes[side], wanted):
                raise UserError(problem)
        free = [view.name for view in views if view.place is None]
        if free:
            print(f"held freely in air, for the session has no such place: {', '.join(free)}")
    else:
        views = [_live_view(options, calibration, session, words)]
    result = check(calibration, views, options.limit)
    print(report(result))
    if options.json is not None:
        write_json(options.json, figures(result))
    return EXIT_DONE if result.ok else EXIT_MISSED


def _live_view(
    options: Namespace, calibration: StereoCalibration, session: Session, words: list[str]
) -> BoardView:
    name = str(options.live)
    if session.place_of(name) is None:
        raise UserError(f"--live {name} is none of the session's places")
    context = Context()
    restrict_discovery()
    remove_incomplete_ports()
    rclpy.init(args=words, context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        pairs = _Capture(context, calibration, options).take()
    finally:
        rclpy.try_shutdown(context=context)
    return averaged_view(name, session, pairs)


class _Capture(WholeNode):
    """Takes a number of image pairs from the topics."""

    def __init__(
        self, context: Context, calibration: StereoCalibration, options: Namespace
    ) -> None:
        super().__init__("check_calibration", context=context)
        self._options = options
        self._cameras = calibration.cameras
        self._matcher: PairMatcher[Frame] = PairMatcher(round(1e9 * options.pair_tolerance))
        self._pairs: list[dict[str, np.ndarray]] = []
        self._problem = ""
        for side in SIDES:
            self.create_subscription(
                Image,
                f"stereo/{side}/image_raw",
                lambda message, side=side: self._on_image(side, message),
                IMAGES_BEST_EFFORT,
            )

    def take(self) -> list[dict[str, np.ndarray]]:
        """Return the pairs.

        Raises
        ------
        UserError
            Images that are not of the calibrated cameras, or too few in the given time.
        """
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        end = time.monotonic() + self._options.timeout
        try:
            while len(self._pairs) < self._options.count and not self._problem:
                left = end - time.monotonic()
                if left <= 0.0:
                    raise UserError(
                        f"{len(self._pairs)} image pairs of {self._options.count} in "
                        f"{self._options.timeout:g} s on stereo/{{left,right}}/image_raw "
                        f"(without a partner: {self._matcher.unpaired.total()})"
                    )
                executor.spin_once(timeout_sec=left)
        finally:
            executor.shutdown()
            self.destroy_node()
        if self._problem:
            raise UserError(self._problem)
        return self._pairs

    def _on_image(self, side: str, message: Image) -> None:
        frame = frame_of(message, side, self._cameras[side])
        self._problem = self._problem or frame.problem
        pair = self._matcher.add(side, to_nanoseconds(message.header.stamp), frame)
        if pair is not None and pair.left.pixels is not None and pair.right.pixels is not None:
            self._pairs.append({"left": pair.left.pixels.copy(), "right": pair.right.pixels.copy()})


if __name__ == "__main__":
    sys.exit(main())
