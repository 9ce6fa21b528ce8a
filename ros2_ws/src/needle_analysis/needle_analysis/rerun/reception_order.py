"""The messages of a bag that the controller heard, in the order in which it heard them.

needle/controller_status tells what the controller had heard since the status before, message by
message (`needle_controller.controller_status`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rosbags.typesys import Stores, get_typestore

from needle_bags.reading.bag_order import SentMessage
from needle_controller.controller_status import ReceivedMessage, received_messages

_STATUS = "needle/controller_status"
_STORE = get_typestore(Stores.ROS2_JAZZY)


def in_reception_order(
    messages: list[SentMessage], namespace: str
) -> list[tuple[int, SentMessage]]:
    """Return the messages with the times by which the controller had heard them, in their order.

    Parameters
    ----------
    messages : list of SentMessage
        Everything small in a bag.
    namespace : str
        Of the rig's topics, `/` or with one at its end.

    Returns
    -------
    list of tuple
        Time [ns] and message: that of sending, or the least later one that keeps the order of
        hearing. Topics that no status tells of count as heard when they were sent. What was sent
        before the last of its topic that was heard, and is told by no status, is left out.
    """
    ordered = sorted(messages, key=lambda m: (m.time, m.log_time))
    heard_at: dict[tuple[str, int], int] = {}
    time = 0
    told = list(_told(ordered, namespace))
    for status, heard in told:
        for topic, sent_ns in heard:
            time = max(time + 1, sent_ns)
            heard_at.setdefault((namespace + topic, sent_ns), time)
        # A status comes after what it tells of.
        time = heard_at[status.topic, status.time] = max(time + 1, status.time)
    last: dict[str, int] = {}
    for topic, sent_ns in heard_at:
        last[topic] = max(sent_ns, last.get(topic, 0))
    # What no status tells of any more was heard after the last one.
    rest = dict.fromkeys(last, time + 1)
    timed = [
        (heard_at.get((m.topic, m.time)) or max(m.time, rest.get(m.topic, 0)), m)
        for m in ordered
        if (m.topic, m.time) in heard_at or m.time >= last.get(m.topic, 0)
    ]
    # Equal times keep the order of sending.
    return sorted(timed, key=lambda pair: pair[0])


def _told(
    messages: Iterable[SentMessage], namespace: str
) -> Iterator[tuple[SentMessage, list[ReceivedMessage]]]:
    for message in messages:
        if message.topic == namespace + _STATUS:
            status: Any = _STORE.deserialize_cdr(message.data, message.type_name)
            values = {pair.key: pair.value for pair in status.values}
            yield message, received_messages(values.get("heard", ""))
