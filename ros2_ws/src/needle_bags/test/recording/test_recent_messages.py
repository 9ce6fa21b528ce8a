from __future__ import annotations

from needle_bags.recording.recent_messages import RecentMessages
from needle_bags.recording.recording import Received

SECOND = 1_000_000_000


def message(topic: str, seconds: float) -> Received:
    time = round(seconds * SECOND)
    return Received(topic, bytes(100), time, time)


def test_the_last_seconds_are_kept() -> None:
    recent = RecentMessages(2.0, 10**9)
    for tenth in range(100):
        recent.put(message("/a", 0.1 * tenth))
    kept = recent.drain()
    assert [m.log_time for m in kept] == [round(0.1 * t * SECOND) for t in range(79, 100)]
    assert recent.drain() == []
    assert recent.memory == 0
