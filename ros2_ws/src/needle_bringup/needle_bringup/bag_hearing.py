"""When the controller heard what was sent, as far as a bag tells.

A node on a busy machine hears a message some time after it was sent, and what had been sent
meanwhile may be heard before it. Where that decides which tip a step is made from, the bag tells by
what the controller did: it had heard of the device before it said so in its status, and it heard a
tip that it used just before it published the estimate.
"""

from __future__ import annotations

from bisect import bisect_left

from needle_bringup.bag_copy import stamp_of
from needle_bringup.bag_order import SentMessage

_DEVICE = ("device/status", "device/result")
# A status later than this was about something else [ns].
_LONGEST = 1_000_000_000


def as_heard(messages: list[SentMessage], namespace: str) -> list[SentMessage]:
    """Return the messages with the times at which the controller heard them.

    Parameters
    ----------
    messages : list of SentMessage
        Everything small in a bag.
    namespace : str
        Of the rig's topics, `/` or with one at its end.
    """
    statuses = sorted(m.time for m in messages if m.topic == f"{namespace}needle/controller_status")
    used = {stamp_of(m.data): m.time for m in messages if m.topic == f"{namespace}needle/estimate"}
    device = {namespace + name for name in _DEVICE}
    heard: list[SentMessage] = []
    tip_heard = 0
    for message in sorted(messages, key=lambda m: m.time):
        time = message.time
        if message.topic in device:
            after = bisect_left(statuses, time)
            if after < len(statuses) and statuses[after] - time <= _LONGEST:
                time = max(time, statuses[after] - 1)
        elif message.topic == f"{namespace}needle/tip":
            # A topic keeps its order: no tip is heard before the one before it.
            time = tip_heard = max(time, tip_heard, used.get(stamp_of(message.data), 0) - 1)
        heard.append(message._replace(time=time))
    return heard
