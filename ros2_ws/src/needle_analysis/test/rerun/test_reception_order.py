from __future__ import annotations

from rosbags.typesys import Stores, get_typestore

from needle_analysis.rerun.reception_order import in_reception_order
from needle_bags.reading.bag_order import SentMessage
from needle_controller.protocol.heard_messages import HeardMessages

STORE = get_typestore(Stores.ROS2_JAZZY)
HEADER, STATUS = "std_msgs/msg/Header", "diagnostic_msgs/msg/DiagnosticStatus"
PAIR = STORE.types["diagnostic_msgs/msg/KeyValue"]


def sent(time: int, topic: str) -> SentMessage:
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    data = bytes(STORE.serialize_cdr(STORE.types[HEADER](stamp=stamp, frame_id=""), HEADER))
    return SentMessage(time, time, f"/rig/{topic}", HEADER, data)


def status(time: int, *heard: tuple[str, int]) -> SentMessage:
    """What the controller said; `("joints", 7)` is that it had heard the joints sent at 7."""
    told = HeardMessages()
    for topic, sent_ns in heard:
        told.add(topic, sent_ns)
    values = [PAIR(key="heard", value=told.take_text())]
    message = STORE.types[STATUS](level=0, name="", message="", hardware_id="", values=values)
    data = bytes(STORE.serialize_cdr(message, STATUS))
    return SentMessage(time, time, "/rig/needle/controller_status", STATUS, data)


def order(*messages: SentMessage) -> list[tuple[str, int]]:
    heard = in_reception_order(list(messages), "/rig/")
    assert [time for time, _ in heard] == sorted(time for time, _ in heard)
    assert all(time >= message.time for time, message in heard)
    return [(message.topic.rsplit("/", maxsplit=1)[-1], message.time) for _, message in heard]


def test_the_order_is_that_of_hearing() -> None:
    found = order(
        sent(10, "joints"),
        sent(11, "result"),
        sent(12, "tip"),
        sent(20, "joints"),
        status(30, ("tip", 12), ("joints", 10)),
        sent(40, "joints"),
        status(50, ("joints", 20), ("result", 11), ("joints", 40)),
    )
    assert found == [
        ("tip", 12),
        ("joints", 10),
        ("controller_status", 30),
        ("joints", 20),
        ("result", 11),
        ("joints", 40),
        ("controller_status", 50),
    ]


def test_what_the_last_status_does_not_tell_was_heard_after_it() -> None:
    found = order(
        sent(10, "joints"),
        sent(15, "joints"),
        sent(16, "other"),
        status(20, ("joints", 10)),
        sent(30, "joints"),
    )
    assert found == [
        ("joints", 10),
        ("other", 16),
        ("controller_status", 20),
        ("joints", 15),
        ("joints", 30),
    ]


def test_of_bags_that_do_not_tell_the_order_is_that_of_sending() -> None:
    assert [time for _, time in order(status(20), sent(10, "joints"))] == [10, 20]


def test_what_was_sent_before_the_last_that_was_heard_and_is_not_told_was_never_heard() -> None:
    found = order(
        sent(10, "joints"),
        sent(11, "other"),
        sent(20, "joints"),
        status(25, ("joints", 20)),
        sent(30, "joints"),
        sent(40, "joints"),
        status(45, ("joints", 40)),
        sent(50, "joints"),
    )
    assert found == [
        ("other", 11),
        ("joints", 20),
        ("controller_status", 25),
        ("joints", 40),
        ("controller_status", 45),
        ("joints", 50),
    ]
