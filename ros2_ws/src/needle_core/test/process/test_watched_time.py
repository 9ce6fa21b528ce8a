import pytest

from needle_core.process.watched_time import LONGEST_LOOK, WatchedTime


def test_goes_by_as_steady_time_while_it_is_read() -> None:
    watched = WatchedTime()
    begin = watched.read(100.0)
    for tenth in range(1, 31):
        watched.read(100.0 + 0.1 * tenth)
    assert watched.read(103.0) - begin == pytest.approx(3.0)


def test_what_nobody_looked_at_is_no_wait() -> None:
    watched = WatchedTime()
    begin = watched.read(100.0)
    assert watched.read(500.0) - begin == LONGEST_LOOK
    assert watched.read(500.1) - begin == pytest.approx(LONGEST_LOOK + 0.1)
