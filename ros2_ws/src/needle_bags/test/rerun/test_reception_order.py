from __future__ import annotations

from functools import partial

import pytest

from made_up_run import header, serialized, status
from needle_bags.reading.bag_messages import SentMessage
from needle_bags.rerun.bag_pass import in_reception_order

HEADER, STATUS = "std_msgs/msg/Header", "diagnostic_msgs/msg/DiagnosticStatus"


def sent(time: int, topic: str) -> SentMessage:
    return SentMessage(time, time, f"/rig/{topic}", HEADER, serialized(header(0)))


def reception(time: int, *received: tuple[str, int]) -> SentMessage:
    """Return a controller status; `("joints", 7)`: it had received the joints sent at 7."""
    heard = ", ".join(f"{topic} {sent_ns}" for topic, sent_ns in received)
    data = serialized(status({"heard": heard}))
    return SentMessage(time, time, "/rig/needle/controller_status", STATUS, data)


J, X, S = "joints", "other", "controller_status"
SENT = partial(map, lambda pair: sent(*pair))


@pytest.mark.parametrize(
    ("messages", "received"),
    [
        (  # The order is that of reception.
            [
                *SENT([(10, J), (11, "result"), (12, "tip"), (20, J)]),
                *(reception(30, ("tip", 12), (J, 10)), sent(40, J)),
                reception(50, (J, 20), ("result", 11), (J, 40)),
            ],
            [("tip", 12), (J, 10), (S, 30), (J, 20), ("result", 11), (J, 40), (S, 50)],
        ),
        (  # Messages that the last status lacks were received after it.
            [*SENT([(10, J), (15, J), (16, X)]), reception(20, (J, 10)), sent(30, J)],
            [(J, 10), (X, 16), (S, 20), (J, 15), (J, 30)],
        ),
        # Without such statuses, the order is that of sending.
        ([reception(20), sent(10, J)], [(J, 10), (S, 20)]),
        (  # An unlisted message older than the last received one was never received.
            [
                *SENT([(10, J), (11, X), (20, J)]),
                *(reception(25, (J, 20)), *SENT([(30, J), (40, J)])),
                *(reception(45, (J, 40)), sent(50, J)),
            ],
            [(X, 11), (J, 20), (S, 25), (J, 40), (S, 45), (J, 50)],
        ),
    ],
)
def test_the_order_is_that_of_reception(
    messages: list[SentMessage], received: list[tuple[str, int]]
) -> None:
    found = in_reception_order(list(messages), "/rig/")
    assert [time for time, _ in found] == sorted(time for time, _ in found)
    assert all(time >= message.time for time, message in found)
    assert [(one.topic.rsplit("/", maxsplit=1)[-1], one.time) for _, one in found] == received
