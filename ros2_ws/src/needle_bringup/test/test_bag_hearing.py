from __future__ import annotations

from rosbags.typesys import Stores, get_typestore

from needle_bringup.bag_hearing import as_heard
from needle_bringup.bag_order import SentMessage

STORE = get_typestore(Stores.ROS2_JAZZY)
HEADER = "std_msgs/msg/Header"
MILLISECOND = 1_000_000
SECOND = 1000 * MILLISECOND


def sent(time_ms: float, topic: str, stamp: int = 0) -> SentMessage:
    time = STORE.types["builtin_interfaces/msg/Time"](sec=0, nanosec=stamp)
    data = bytes(STORE.serialize_cdr(STORE.types[HEADER](stamp=time, frame_id=""), HEADER))
    when = SECOND + round(time_ms * MILLISECOND)
    return SentMessage(when, when, f"/rig/{topic}", HEADER, data)


def order(*messages: SentMessage) -> list[str]:
    heard = sorted(as_heard(list(messages), "/rig/"), key=lambda m: (m.time, m.log_time))
    return [m.topic.rsplit("/", maxsplit=1)[-1] for m in heard]


def test_a_tip_that_was_used_was_heard_after_the_result_though_sent_before() -> None:
    result = sent(10, "device/result")
    tip = sent(9, "needle/tip", stamp=7)
    asked = sent(20, "needle/controller_status")
    estimate = sent(25, "needle/estimate", stamp=7)
    assert order(tip, result, asked, estimate) == ["result", "controller_status", "tip", "estimate"]


def test_tips_keep_their_order() -> None:
    used, later = sent(9, "needle/tip", stamp=7), sent(11, "needle/tip", stamp=8)
    estimate = sent(25, "needle/estimate", stamp=7)
    heard = [m for m in as_heard([used, later, estimate], "/rig/") if m.topic.endswith("tip")]
    assert heard[0].data == used.data
    assert heard[0].time <= heard[1].time


def test_nothing_is_heard_before_it_was_sent() -> None:
    messages = [
        sent(10, "device/result"),
        sent(12, "needle/tip", stamp=7),
        sent(13, "needle/controller_status"),
        sent(11, "needle/estimate", stamp=7),
    ]
    assert all(heard.time >= heard.log_time for heard in as_heard(messages, "/rig/"))
