"""`ros2 run needle_tracker check_calibration`: check that a calibration still fits the rig."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Image

from needle_core.commands.cli import EXIT_DONE, EXIT_MISSED, run_command, write_json
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_core.message_types import to_nanoseconds
from needle_core.process.discovery import restrict_discovery
from needle_core.process.shared_memory import remove_incomplete_ports
from needle_core.ros.base_node import IMAGES_BEST_EFFORT, WholeNode, spin_until
from needle_core.settings.bounds import check_bounds
from needle_tracker.answers.tracker_messages import frame_of
from needle_tracker.calibrating.calibration_check import check, figures, report
from needle_tracker.calibrating.calibration_session import (
    HELD_FREELY,
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
_LIVE_PAIRS, _TIMEOUT = 10, 10.0  # pairs that are averaged, and the wait for them [s]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = list(sys.argv if arguments is None else ["check_calibration", *arguments])
    return run_command(lambda: check_calibration(parse(remove_ros_args(words)[1:])))


def parse(arguments: Sequence[str]) -> Namespace:
    """Return the options of a command line, without the name of the program.

    Raises
    ------
    UserError
        Contradictory options, or a number out of bounds.
    """
    parser = CommandParser("check_calibration", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add("--calibration", type=Path, required=True, metavar="FILE", help="calibration to check")
    add("--session", type=Path, required=True, metavar="FILE", help="board and places (YAML)")
    add("--left", type=Path, metavar="DIR", help="images of the left camera")
    add("--right", type=Path, metavar="DIR", help="images of the right camera")
    add("--live", metavar="NAME", help="use images from topics, the board at this place")
    add("--limit-mm", type=float, default=0.15, metavar="MM", help="accepted tip error (0.15)")
    add("--json", type=Path, metavar="FILE", help="also write the figures as flat JSON")
    given = parser.parse_args(arguments)
    if len({given.left is None, given.right is None, given.live is not None}) > 1:
        raise UserError("give either --left and --right, or --live; see --help")
    check_bounds("--limit-mm", given.limit_mm, 0.001, 10.0, "mm")
    return given


def check_calibration(options: Namespace) -> int:
    """Check the calibration, print and write the result."""
    calibration, session = load_calibration(options.calibration), load_session(options.session)
    if options.left is not None and options.right is not None:
        views, sizes = views_in_folders(options.left, options.right, session, all_places=False)
        for side, expected in calibration.sizes.items():
            if problem := size_problem(side, sizes[side], expected):
                raise UserError(problem)
        if free := [view.name for view in views if view.kind == "free"]:
            print(f"held freely in air, as the session has no such place: {', '.join(free)}")
    else:
        views = [_live_view(str(options.live), calibration, session)]
    result = check(calibration, views, 1e-3 * options.limit_mm)
    print(report(result))
    write_json(options.json, figures(result))
    return EXIT_DONE if result.ok else EXIT_MISSED


def _live_view(name: str, calibration: StereoCalibration, session: Session) -> BoardView:
    if session.place_of(name) is HELD_FREELY:
        raise UserError(f"--live {name} is none of the session's places")
    restrict_discovery()
    remove_incomplete_ports()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        return averaged_view(name, session, _live_pairs(calibration))
    finally:
        rclpy.try_shutdown()


def _live_pairs(calibration: StereoCalibration) -> list[tuple[np.ndarray, np.ndarray]]:
    """Receive image pairs; raise a `UserError` for images of other cameras, or too few."""
    node = WholeNode("check_calibration")
    # The board is at rest: images of cameras without a trigger may be half a frame apart.
    matcher: PairMatcher[np.ndarray] = PairMatcher(None)
    pairs: list[tuple[np.ndarray, np.ndarray]] = []

    def receive(side: str, message: Image) -> None:
        frame = frame_of(message, side, calibration.cameras[side])
        if frame.pixels is None:
            raise UserError(frame.problem)
        stamp_ns = to_nanoseconds(message.header.stamp)
        if pair := matcher.add(side, stamp_ns, frame.pixels.copy()):
            pairs.append((pair.left, pair.right))

    for side in SIDES:
        on_image = partial(receive, side)
        node.create_subscription(Image, f"stereo/{side}/image_raw", on_image, IMAGES_BEST_EFFORT)
    spin_until(node, lambda: len(pairs) >= _LIVE_PAIRS, _TIMEOUT)
    if len(pairs) < _LIVE_PAIRS:
        raise UserError(
            f"{len(pairs)} image pairs of {_LIVE_PAIRS} in {_TIMEOUT:g} s on "
            f"stereo/{{left,right}}/image_raw (without a partner: {matcher.unpaired.total()})"
        )
    return pairs


if __name__ == "__main__":
    sys.exit(main())
