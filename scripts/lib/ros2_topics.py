"""`ros2 topic echo`, `hz` and `pub` of the small `ros2`."""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections import deque
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
    qos_profile_sensor_data,
)

from ros2_messages import fill, find_type, parse, to_yaml
from ros2_spinning import PATIENCE, GraphError, spin_until

KEEP_ALIVE = 0.1
WINDOW = 10_000


def _message_type(node: Node, topic: str, timeout: float) -> Any:
    """Return the class of a topic's messages; wait for its publisher."""
    full_name = node.resolve_topic_name(topic)
    found: list[str] = []

    def is_there() -> bool:
        found.extend(dict(node.get_topic_names_and_types()).get(full_name, ()))
        return bool(found)

    if not spin_until(node, is_there, min(timeout, PATIENCE)):
        print(f"WARNING: topic [{topic}] does not appear to be published yet", flush=True)
        if not spin_until(node, is_there, timeout - PATIENCE):
            raise GraphError("Could not determine the type for the passed topic")
    if len(set(found)) > 1:
        raise GraphError(
            f"Cannot echo topic '{topic}', as it contains more than one type: "
            f"[{', '.join(sorted(set(found)))}]"
        )
    return find_type(found[0], "msg")


def _qos_of_publishers(node: Node, topic: str) -> QoSProfile:
    """Return a profile that hears every publisher of the topic."""
    offered = [
        info.qos_profile
        for info in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    ]
    profile = QoSProfile(depth=qos_profile_sensor_data.depth)
    if not (offered and all(one.reliability == QoSReliabilityPolicy.RELIABLE for one in offered)):
        profile.reliability = QoSReliabilityPolicy.BEST_EFFORT
    if offered and all(one.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL for one in offered):
        profile.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL
    return profile


def echo(node: Node, options: argparse.Namespace) -> None:
    """Print a topic's messages."""
    message_type = _message_type(node, options.topic_name, PATIENCE)
    fields = [name for name in (options.field or "").split(".") if name]
    seen: list[None] = []

    def show(message: Any) -> None:
        if options.once and seen:
            return
        # As in the real one, it is the user's own program.
        if options.filter is not None and not eval(options.filter, {"m": message}):
            return
        for name in fields:
            if not hasattr(message, name):
                raise GraphError(f"Invalid field '{options.field}': no '{name}'")
            message = getattr(message, name)
        simple = not hasattr(message, "get_fields_and_field_types")
        text = f"{message}\n" if simple else to_yaml(message)
        print(text, end="---\n", flush=True)
        seen.append(None)

    qos = _qos_of_publishers(node, options.topic_name)
    node.create_subscription(message_type, options.topic_name, show, qos)
    limit = options.timeout or float("inf")
    spin_until(node, lambda: bool(seen) and options.once, limit)


def hz(node: Node, options: argparse.Namespace) -> None:
    """Print once a second how often a topic's messages come."""
    message_type = _message_type(node, options.topic_name, float("inf"))
    arrivals: deque[float] = deque(maxlen=WINDOW + 1)
    node.create_subscription(
        message_type,
        options.topic_name,
        lambda _: arrivals.append(time.monotonic()),
        qos_profile_sensor_data,
        raw=True,
    )
    shown = time.monotonic()
    while True:
        rclpy.spin_once(node, timeout_sec=0.1)
        now = time.monotonic()
        if now < shown + 1.0 or len(arrivals) < 2 or arrivals[-1] < shown:
            continue
        shown = now
        periods = [b - a for a, b in itertools.pairwise(arrivals)]
        print(
            f"average rate: {1.0 / statistics.fmean(periods):.3f}\n"
            f"\tmin: {min(periods):.3f}s max: {max(periods):.3f}s "
            f"std dev: {statistics.pstdev(periods):.5f}s window: {len(periods)}",
            flush=True,
        )


def pub(node: Node, options: argparse.Namespace) -> None:
    """Publish a message once, a number of times, or until interrupted."""
    message = find_type(options.message_type, "msg")()
    stamps = fill(message, parse(options.values))
    times = 1 if options.once else options.times
    # Heard by whoever wants the last message of a topic, as of targets, and by all others, too.
    latched = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(type(message), options.topic_name, latched)
    # As the real one: who is to hear a number of messages must be there.
    while times and not spin_until(node, publisher.get_subscription_count, 1.0):
        print("Waiting for at least 1 matching subscription(s)...", flush=True)
    print("publisher: beginning loop", flush=True)
    due = time.monotonic()
    for count in itertools.count(1):
        stamp = node.get_clock().now().to_msg()
        for set_stamp in stamps:
            set_stamp(stamp)
        if options.print and count % options.print == 0:
            print(f"publishing #{count}: {message!r}\n", flush=True)
        publisher.publish(message)
        if count == times:
            break
        due = max(due + 1.0 / options.rate, time.monotonic())
        spin_until(node, lambda: False, due - time.monotonic())
    spin_until(node, lambda: False, KEEP_ALIVE)
