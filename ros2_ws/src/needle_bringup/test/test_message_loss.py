from __future__ import annotations

from collections.abc import Sequence

import pytest

from needle_bringup.message_loss import SequenceGaps


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        ((1, 2, 3, 4), 0),
        ((7, 8, 9), 0),  # the recorder came late
        ((1, 2, 5, 6), 2),
        ((1, 3, 5), 2),
        ((1, 2, 1001, 3, 1002, 4), 998),  # a second publisher that was not announced
        ((1, 1, 2, 2, 3, 3), 0),  # two publishers in step
        ((5, 6, 1, 7, 2, 8, 3), 0),  # a second publisher begins
        ((5, 6, 6, 7), 0),  # a repeat
    ],
)
def test_gaps(numbers: Sequence[int], missing: int) -> None:
    gaps = SequenceGaps()
    for number in numbers:
        gaps.take(number)
    assert gaps.missing == missing


def test_another_publisher_is_no_gap_once_it_is_known() -> None:
    gaps = SequenceGaps()
    for number in (1, 2, 3):
        gaps.take(number)
    gaps.forget()
    gaps.take(50)
    assert gaps.missing == 0
