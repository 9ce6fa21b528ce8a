from __future__ import annotations

from needle_bags.recording.recent_messages import RecentMessages
from needle_bags.recording.recording import OVERHEAD, Received

SECOND = 1_000_000_000


def message(topic: str, seconds: float, size: int = 100) -> Received:
    time = round(seconds * SECOND)
    return Received(topic, bytes(size), time, time)


def test_the_last_seconds_are_kept() -> None:
    recent = RecentMessages(2.0, 10**9)
    for tenth in range(100):
        recent.put(message("/a", 0.1 * tenth))
    kept = recent.take()
    assert [m.log_time for m in kept] == [round(0.1 * t * SECOND) for t in range(79, 100)]
    assert recent.take() == []
    assert recent.memory == 0


def test_memory_of_recent_messages_is_bounded() -> None:
    limit = 50_000
    recent = RecentMessages(1e3, limit)
    for second in range(200):
        recent.put(message("/image", second, size=5000))
        assert recent.memory <= limit
    kept = recent.take()
    assert len(kept) == limit // (5000 + OVERHEAD)
    assert kept[-1].log_time == 199 * SECOND


def test_the_last_latched_message_is_kept_once() -> None:
    recent = RecentMessages(1.0, 10**9)
    recent.latch("/plane")
    for seconds in (0.0, 0.1):
        recent.put(message("/plane", seconds))
        recent.put(message("/other", seconds))
    recent.put(message("/other", 10.0))
    told = [(m.topic, m.log_time / SECOND) for m in recent.take()]
    assert told == [("/plane", 0.1), ("/other", 10.0)]
    recent.put(message("/other", 20.0))
    assert [m.topic for m in recent.take()] == ["/other"]
