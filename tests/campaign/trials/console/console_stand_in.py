"""The console's hold alone, as a process: a page of one button, and the topic behind it.

`python -m campaign.trials.console.console_stand_in` prints the ports of page and hold, and
runs until its input ends.
"""

from __future__ import annotations

import json
import sys

import rclpy

from campaign.trials.console.button_page import serving_button
from campaign.trials.holds.hold_topic import HoldTopic
from needle_console.hold.hold_state import OWNER, HoldState
from needle_core.messages import HOLD_LIFETIME
from needle_core.ros.whole_node import WholeNode


def main() -> int:
    """Serve until the input ends; returns the exit code."""
    rclpy.init(args=[])
    node = WholeNode("console_stand_in")
    topic = HoldTopic(node, OWNER, HOLD_LIFETIME)

    def publish(state: HoldState) -> None:
        topic.publish(pressed=state.pressed, speed=state.speed)

    with serving_button(publish, node.get_logger().warning) as (page_port, hold):
        print(json.dumps({"page": page_port, "hold": hold.port}), flush=True)
        sys.stdin.read()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
