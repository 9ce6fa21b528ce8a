"""What a log says of what goes wrong without end."""

from __future__ import annotations

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.reports import MOST_NOTICES, Notice, NoticeLimit

REFUSED = Notice("refused", Rule.TIP_AGE)


def test_a_flood_is_counted_and_not_told() -> None:
    limit = NoticeLimit()
    told = [limit.admit(REFUSED, 100.0 + number * 1e-3) for number in range(999)]
    assert [text for text in told if text] == ["refused [tip_age]"] * MOST_NOTICES
    assert (
        limit.admit(REFUSED, 101.0)
        == f"refused [tip_age] ({999 - MOST_NOTICES} more were not told)"
    )
    assert limit.admit(REFUSED, 101.1) == "refused [tip_age]"


def test_one_rule_takes_no_room_from_another_nor_from_a_fault() -> None:
    limit = NoticeLimit()
    for _ in range(2 * MOST_NOTICES):
        limit.admit(REFUSED, 1.0)
    assert limit.admit(Notice("late", Rule.HOLD_AGE), 1.0) == "late [hold_age]"
    assert limit.admit(Notice("stopped", Rule.TIP_AGE, fault=True), 1.0) == "stopped [tip_age]"
