"""Messages of a bag in the order in which the controller received them.

needle/controller_status lists the messages received since the previous status
(`needle_controller.controller_status`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rosbags.typesys import Stores, get_typestore

from needle_bags.reading.bag_messages import SentMessage
from needle_controller.controller_status import ReceivedMessage, received_messages

_STATUS = "needle/controller_status"
_STORE = get_typestore(Stores.ROS2_JAZZY)


def in_reception_order(
    messages: list[SentMessage], namespace: str
) -> list[tuple[int, SentMessage]]:
    """Return the messages with their times of reception by the controller, in that order.

    Parameters
    ----------
    messages : list of SentMessage
        All small messages of a bag.
    namespace : str
        Namespace of the rig's topics, ends with `/`.

    Returns
    -------
    list of tuple
        Time [ns] and message: the time of sending, or the earliest later one that keeps the order
        of reception. Messages of topics that no status lists are received when they were sent. A
        message that is not listed, although a later one of its topic is, is left out.
    """
    ordered = sorted(messages, key=lambda m: (m.time, m.log_time))
    received_at: dict[tuple[str, int], int] = {}
    time = 0
    for status, received in _statuses(ordered, namespace):
        for topic, sent_ns in received:
            time = max(time + 1, sent_ns)
            received_at.setdefault((namespace + topic, sent_ns), time)
        # A status follows the messages that it lists.
        time = received_at[status.topic, status.time] = max(time + 1, status.time)
    last: dict[str, int] = {}
    for topic, sent_ns in received_at:
        last[topic] = max(sent_ns, last.get(topic, 0))
    # Messages after the last status were received after it.
    rest = dict.fromkeys(last, time + 1)
    timed = [
        (received_at.get((m.topic, m.time)) or max(m.time, rest.get(m.topic, 0)), m)
        for m in ordered
        if (m.topic, m.time) in received_at or m.time >= last.get(m.topic, 0)
    ]
    # Equal times keep the order of sending.
    return sorted(timed, key=lambda pair: pair[0])


def _statuses(
    messages: Iterable[SentMessage], namespace: str
) -> Iterator[tuple[SentMessage, list[ReceivedMessage]]]:
    for message in messages:
        if message.topic == namespace + _STATUS:
            status: Any = _STORE.deserialize_cdr(message.data, message.type_name)
            values = {pair.key: pair.value for pair in status.values}
            yield message, received_messages(values.get("heard", ""))
