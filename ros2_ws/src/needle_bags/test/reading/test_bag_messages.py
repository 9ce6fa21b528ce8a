from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from made_up_run import header, serialized
from needle_bags.format.bag_writer import BagWriter, standard_topic
from needle_bags.reading.bag_messages import raw_as_sent

TYPE, IMAGE = "std_msgs/msg/Header", "sensor_msgs/msg/Image"
MILLISECOND = 1_000_000
START = 1_700_000_000_000_000_000
QUESTIONS, ANSWERS, LARGE = "/questions", "/answers", "/large"


def write(directory: Path, delay_of: Callable[[str, int], int], *, count: int = 30) -> None:
    """Write questions and answers 1 ms apart, each received after the delay of its topic."""
    bag = BagWriter(directory)
    for name, kind in ((QUESTIONS, TYPE), (ANSWERS, TYPE), (LARGE, IMAGE)):
        bag.add_topic(standard_topic(name, kind))
    messages = []
    for number in range(count):
        for place, name in enumerate((QUESTIONS, LARGE, ANSWERS)):
            sent = START + (10 * number + place) * MILLISECOND
            messages.append((sent + delay_of(name, number), sent, name))
    for received, sent, name in sorted(messages):
        bag.write(name, serialized(header(sent - START, name)), received, sent)
    bag.close()


def order(bag: Path) -> list[str]:
    return [sent.topic for sent in raw_as_sent(bag, lambda _: True)]


def test_a_late_request_still_precedes_its_answer(tmp_path: Path) -> None:
    def delay(topic: str, number: int) -> int:
        return 5 * MILLISECOND if topic == QUESTIONS and number % 3 else 0

    write(tmp_path / "bag", delay)
    assert order(tmp_path / "bag") == [QUESTIONS, LARGE, ANSWERS] * 30


@pytest.mark.parametrize("skew", [-20 * MILLISECOND, 5_000 * MILLISECOND])
def test_with_another_clock_the_order_of_reception_is_kept(tmp_path: Path, skew: int) -> None:
    """The answerer's clock is wrong: messages are ordered by reception, not by their stamps."""
    write(tmp_path / "bag", lambda topic, _: skew if topic == ANSWERS else 0)
    received = [m.log_time for m in raw_as_sent(tmp_path / "bag", lambda _: True)]
    assert received == sorted(received)
