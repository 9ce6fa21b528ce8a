from __future__ import annotations

import pytest

from needle_bags.format.message_loss import FINAL_AFTER, SequenceGaps


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        ((7, 8, 9), 0),  # the recorder started late
        ((1, 3, 5), 2),
        ((1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 20), 9),
        ((1, 2, 1001, 3), 0),  # a second publisher that was not discovered
        ((8, 9, 1, 2, 3), 0),  # the publisher was restarted
        ((5, 6, 6, 7), 0),  # a duplicate
    ],
)
def test_gaps(numbers: tuple[int, ...], missing: int) -> None:
    gaps = SequenceGaps()
    for number in numbers:
        gaps.add(number)
    assert gaps.missing == missing


def test_a_jump_before_the_discovery_of_a_publisher_is_no_gap() -> None:
    gaps = SequenceGaps()
    for number in (1, 2, 3, 50):
        gaps.add(number)
    gaps.reset()
    gaps.add(51)
    assert gaps.missing == 0


def test_a_gap_remains_after_a_change_of_publishers() -> None:
    gaps = SequenceGaps()
    for number in (1, *range(4, 5 + FINAL_AFTER)):
        gaps.add(number)
    gaps.reset()
    assert gaps.missing == 2
