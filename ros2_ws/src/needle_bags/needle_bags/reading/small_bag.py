"""Copies a bag to one that is small enough for git: a few images, compressed."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.typesys import Stores, get_typestore

from needle_bags.format.bag_writer import BagCopy, stamp_of, standard_topic
from needle_bags.reading.bag_images import TOPICS as IMAGE_TOPICS
from needle_bags.reading.bag_images import pixels_of, plain_image
from needle_bags.reading.bag_messages import SentMessage, raw_as_sent, read_contents
from needle_bags.reading.bag_reader import Run, read_run
from needle_core.commands.cli import EXIT_DONE, run_command
from needle_core.commands.options import CommandParser
from needle_core.errors import UserError

_DESCRIPTION = """
Copy only what a rerun needs from a bag, with the compressed images of a few exposures. The tips of
compressed images differ slightly from the recorded ones: `rerun SMALL_BAG --output DIR` replaces
them with new ones. scripts/renew_regression_bag runs both commands.
"""
# Insertion depths of the kept exposures [m]: consecutive ones, in which the tracker follows the
# tip, and distant ones, where it has to search.
DEPTHS = (30e-3, 31e-3, 32e-3, 75e-3, 76e-3, 110e-3)
QUALITY = 90
NODES = ("sim_rig", "stereo_tracker", "plane_controller")
_LEFT_OUT = ("/diagnostics", "/rosout", "/parameter_events", "/stereo_tracker/calibration")
_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_STORE = get_typestore(Stores.ROS2_JAZZY)


def write_small_bag(source: Path, target: Path) -> None:
    """Write the small bag.

    Parameters
    ----------
    source : Path
        A bag with images.
    target : Path
        The new bag's directory.

    Raises
    ------
    UserError
        If the bag is broken, or the new one exists already or cannot be written.
    """
    run = read_run(source)
    chosen = _exposures(run)
    contents = read_contents(source)
    copy = BagCopy(target, contents.distribution, _custom_data(run))
    images = {run.namespace + name: name for name in IMAGE_TOPICS}
    for message in raw_as_sent(source, lambda name: not name.endswith(_LEFT_OUT)):
        if message.topic not in images:
            topic = contents.topics[message.topic]
            copy.put(topic, message.data, message.log_time, message.time)
        elif stamp_of(message.data) in chosen:
            _put_image(copy, message, source)
    copy.close()


def _exposures(run: Run) -> set[int]:
    """Return the stamps of the exposures whose images are kept."""
    stamps = run.tip_covariances.stamps
    depth = run.insertion_at(stamps)
    if not np.isfinite(depth).any():
        raise UserError(f"{run.path} has no exposures with a known insertion")
    return {int(stamps[np.nanargmin(np.abs(depth - insertion))]) for insertion in DEPTHS}


def _put_image(copy: BagCopy, message: SentMessage, source: Path) -> None:
    image: Any = _STORE.deserialize_cdr(message.data, message.type_name)
    pixels = pixels_of(plain_image(image), source)
    if not pixels.size:
        return
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    content: Any = _STORE.types[_COMPRESSED](
        header=image.header, format="mono8; jpeg compressed mono8", data=encoded.ravel()
    )
    topic = standard_topic(message.topic.removesuffix("/compressed") + "/compressed", _COMPRESSED)
    data = bytes(_STORE.serialize_cdr(content, _COMPRESSED))
    copy.put(topic, data, message.log_time, message.time)


def _custom_data(run: Run) -> dict[str, str]:
    """Return the custom data, without paths on the recording machine."""
    parameters = {
        name: {"ros__parameters": values}
        for name, values in run.parameters.items()
        if name.rsplit("/", maxsplit=1)[-1] in NODES
    }
    return {
        "parameters": yaml.safe_dump(parameters),
        "run_info": json.dumps(run.run_info),
        "calibration": run.calibration,
        "commit": run.commit,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = CommandParser("small_bag", _DESCRIPTION, "")
    parser.add_argument("bag", type=Path, metavar="BAG", help="a bag with images")
    parser.add_argument("small_bag", type=Path, metavar="SMALL_BAG", help="the new bag")

    def command() -> int:
        given = parser.parse_args(arguments)
        write_small_bag(given.bag, given.small_bag)
        return EXIT_DONE

    return run_command(command)


if __name__ == "__main__":
    sys.exit(main())
