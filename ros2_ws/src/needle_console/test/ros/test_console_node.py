"""The console as a ROS node: a hold becomes messages, images are heard while a page asks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image, Joy

from needle_console.console import PAGE, Console
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.hold_state import RELEASED, HoldState, Mode
from needle_console.page.desk import Desk
from needle_core.ros.component_node import ComponentNode
from needle_core.ros.conversions import HOLD, IMAGES
from own_context import own_context

LIMIT = 20.0


class Bench:
    """A console's node, a page's desk, and a rig that hears its hold and publishes images."""

    def __init__(self, rig: Node, console: ComponentNode, desk: Desk) -> None:
        self.desk = desk
        self.holds: list[Joy] = []
        self.images = rig.create_publisher(Image, "stereo/left/image_raw", IMAGES)
        self.sees = rig.create_subscription(Joy, "device/hold", self.holds.append, HOLD)
        self.executor = SingleThreadedExecutor(context=rig.context)
        self.executor.add_node(rig)
        self.executor.add_node(console)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, f"timed out: {what}"
            self.executor.spin_once(timeout_sec=0.01)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with own_context() as context:
        desk = Desk(ConsoleParameters())
        console = ComponentNode(
            Console.name,
            ConsoleParameters,
            lambda settings, _: Console(settings),
            lambda _: {PAGE: desk},
            context=context,
        )
        rig = Node("rig", context=context)
        bench = Bench(rig, console, desk)
        yield bench
        bench.executor.shutdown()
        rig.destroy_node()
        console.destroy_node()


def test_a_hold_at_the_desk_is_a_message_of_the_device(bench: Bench) -> None:
    bench.until(lambda: bench.sees.get_publisher_count() > 0, "the console's hold")

    def says(state: HoldState, button: int) -> bool:
        bench.desk.hold(state)
        return bool(bench.holds) and bench.holds[-1].buttons[0] == button

    bench.until(lambda: says(HoldState(True, 0.5, Mode.INSERT), 1), "a press")
    pressed = bench.holds[-1]
    assert pressed.header.frame_id.startswith("console/")
    assert list(pressed.axes) == pytest.approx([0.5, 0.1])
    bench.until(lambda: says(RELEASED, 0), "a release")


def test_images_are_heard_only_while_a_page_asks_for_views(bench: Bench) -> None:
    def heard() -> bool:
        return bool(bench.images.get_subscription_count())

    bench.until(lambda: bench.sees.get_publisher_count() > 0, "the console")
    assert not heard()
    bench.desk.picture("left")
    bench.until(heard, "a subscription")
    bench.until(lambda: not heard(), "its end")
