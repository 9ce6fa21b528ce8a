"""`ros2 run needle_tracker check_calibration`: check that a calibration still fits the rig."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Image

from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command, write_json
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.message_types import to_nanoseconds
from needle_core.process.discovery import restrict_discovery
from needle_core.process.shared_memory import remove_incomplete_ports
from needle_core.ros.base_node import IMAGES_BEST_EFFORT, WholeNode
from needle_core.settings.bounds import check_bounds
from needle_tracker.answers.pair_answers import Frame
from needle_tracker.answers.tracker_messages import frame_of
from needle_tracker.calibrating.calibration_check import check, figures, report
from needle_tracker.calibrating.calibration_session import (
    BoardView,
    Session,
    averaged_view,
    load_session,
    views_in_folders,
)
from needle_tracker.optics.calibration import SIDES, StereoCalibration, load_calibration
from needle_tracker.sources.image_files import size_problem
from needle_tracker.sources.pairing import PairMatcher

_DESCRIPTION = """\
Check a stereo calibration with a ChArUco board at known places. A camera rotated by 0.02 deg, a
refractive index off by 0.01 or a changed surface height cause tip errors of 0.1 to 0.7 mm without
warning, because both rays still meet. Prints each deviation and the resulting tip error.

The session file is that of calibrate_stereo (see its --help). Place the board flat on the surface
and, tilted, at a known place under it; give each place its true standard deviation `sigma`. A wrong
place looks like a rotation of both cameras.

Recorded images: --left and --right, paired by name. An image without a place in the session counts
as a board held freely in air, which shows little. Live: --live NAME uses pairs of
stereo/{left,right}/image_raw, with the board at rest at the session's place NAME.
"""
_EPILOG = """\
examples:
  ros2 run needle_tracker check_calibration --calibration rig.yaml --session S.yaml --left L --right R
  ros2 run needle_tracker check_calibration --calibration rig.yaml --session S.yaml --live under_wedge

exit codes: 0 OK; 1 NOT OK, or this target cannot show it; 2 invalid input, no images or no board;
130 interrupted
"""  # noqa: E501 - command lines stay whole


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = list(sys.argv if arguments is None else ["check_calibration", *arguments])
    return run_command(lambda: check_calibration(parse(remove_ros_args(words)[1:]), words))


def parse(arguments: Sequence[str]) -> Namespace:
    """Return the options of a command line, without the name of the program; `limit` is in metres.

    Raises
    ------
    UserError
        Contradictory options, or a number out of bounds.
    """
    given = _parser().parse_args(arguments)
    if (given.live is None) != (given.left is not None and given.right is not None):
        raise UserError("give either --left and --right, or --live; see --help")
    if given.live is not None and (given.left is not None or given.right is not None):
        raise UserError("--live takes its images from topics: omit --left and --right")
    for name, lower, upper, unit in (
        ("count", 1, 1000, "pairs"),
        ("timeout", 0.1, 3600.0, "s"),
        ("pair_tolerance", 0.0, 0.1, "s"),
        ("limit_mm", 0.001, 10.0, "mm"),
    ):
        check_bounds(f"--{name.replace('_', '-')}", getattr(given, name), lower, upper, unit)
    given.limit = 1e-3 * given.limit_mm
    return given


def _parser() -> CommandParser:
    parser = CommandParser("check_calibration", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add("--calibration", type=Path, required=True, metavar="FILE", help="calibration to check")
    add("--session", type=Path, required=True, metavar="FILE", help="board and places (YAML)")
    add("--left", type=Path, metavar="DIR", help="images of the left camera")
    add("--right", type=Path, metavar="DIR", help="images of the right camera")
    add("--live", metavar="NAME", help="use images from topics, the board at this place")
    add("--count", type=int, default=10, metavar="N", help="number of live pairs (10)")
    add("--timeout", type=float, default=10.0, metavar="S", help="wait for live pairs (10 s)")
    add("--pair-tolerance", type=float, default=0.0, metavar="S", help="of left and right (0 s)")
    add("--limit-mm", type=float, default=0.15, metavar="MM", help="accepted tip error (0.15)")
    add("--json", type=Path, metavar="FILE", help="also write the figures as flat JSON")
    return parser


def check_calibration(options: Namespace, words: list[str]) -> int:
    """Check the calibration, print and write the result."""
    calibration, session = load_calibration(options.calibration), load_session(options.session)
    if options.left is not None and options.right is not None:
        views, sizes = views_in_folders(options.left, options.right, session, all_places=False)
        for side, wanted in calibration.sizes.items():
            if problem := size_problem(side, sizes[side], wanted):
                raise UserError(problem)
        free = [view.name for view in views if view.place is None]
        if free:
            print(
                f"treated as held freely in air, the session has no such place: {', '.join(free)}"
            )
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
    """Node that receives a number of image pairs."""

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
            Images of other cameras, or too few before the timeout.
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
