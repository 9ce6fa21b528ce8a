from __future__ import annotations

import pytest

from needle_bags.format.message_loss import FINAL_AFTER, SequenceGaps

# Separates numbers at a change of publishers.
CHANGED = 0


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        ((7, 8, 9), 0),  # the recorder started late
        ((1, 3, 5), 2),
        ((1, 2, 1001, 3), 0),  # a second publisher that was not discovered
        ((8, 9, 1, 2, 3), 0),  # the publisher was restarted
        ((5, 6, 6, 7), 0),  # a duplicate
        ((1, 2, 3, 50, CHANGED, 51), 0),  # a jump just before the discovery of a publisher
        ((1, *range(4, 5 + FINAL_AFTER), CHANGED), 2),
    ],
)
def test_gaps(numbers: tuple[int, ...], missing: int) -> None:
    gaps = SequenceGaps()
    for number in numbers:
        if number == CHANGED:
            gaps.reset()
        else:
            gaps.add(number)
    assert gaps.missing == missing
