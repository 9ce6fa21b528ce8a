"""A node whose construction fails is gone, while its error is still held."""

from __future__ import annotations

import time

import pytest
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import Bool

from needle_core.errors import UserError
from needle_core.ros.whole_node import WholeNode
from own_context import own_context

LIMIT = 20.0


class Half(WholeNode):
    """Finds out late that it cannot be."""

    def __init__(self, context: Context) -> None:
        super().__init__("half", context=context)
        self.create_publisher(Bool, "half", 1)
        self.create_subscription(Bool, "half", lambda _: None, 1)
        raise UserError("rate = 0 Hz, must be > 0")


class Misnamed(WholeNode):
    """Fails before there is anything to destroy."""

    def __init__(self, context: Context) -> None:
        super().__init__("no name", context=context)


def names(observer: Node) -> set[str]:
    return {name for name, _ in observer.get_node_names_and_namespaces()}


def test_a_node_whose_construction_fails_is_gone() -> None:
    with own_context() as context:
        observer = Node("observer", context=context)
        with pytest.raises(UserError) as failure:
            Half(context)
        end = time.monotonic() + LIMIT
        # Made after it: who sees this one would see that one, were it there.
        other = WholeNode("other", context=context)
        while "other" not in names(observer) or "half" in names(observer):
            assert time.monotonic() < end, f"seen: {names(observer)}"
        assert observer.get_publishers_info_by_topic("half") == []
        assert observer.get_subscriptions_info_by_topic("half") == []
        assert failure.traceback  # which holds the node
        other.destroy_node()
        observer.destroy_node()


def test_what_fails_in_the_beginning_fails_by_its_own_error() -> None:
    with own_context() as context, pytest.raises(Exception, match="no name"):
        Misnamed(context)
