"""Counts stereo images with the tracker's quality of service, and does nothing else with them.

`python -m campaign.trials.image_listener`: ends when whoever published has gone; prints how many
came of each topic, as JSON.
"""

from __future__ import annotations

import json
from collections import Counter

import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image

from needle_core.process.reach import keep_to_this_machine
from needle_core.ros.conversions import IMAGES
from needle_core.ros.whole_node import WholeNode

TOPICS = ("/stereo/left/image_raw", "/stereo/right/image_raw")


def main() -> None:
    """Listen until nobody publishes any more."""
    keep_to_this_machine()
    rclpy.init(args=[])
    node, counts = WholeNode("image_listener"), Counter(dict.fromkeys(TOPICS, 0))
    for topic in TOPICS:

        def count(_: bytes, topic: str = topic) -> None:
            counts[topic] += 1

        node.create_subscription(Image, topic, count, IMAGES, raw=True)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    began = False
    while not began or node.count_publishers(TOPICS[0]):
        executor.spin_once(timeout_sec=0.1)
        began = began or min(counts.values()) > 0
    print(json.dumps(counts), flush=True)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
