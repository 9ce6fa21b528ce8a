"""Faults begin by what they meet, wherever on the clock that is."""

from __future__ import annotations

from collections.abc import Callable

from needle_core.runners.timeline import Timeline
from scenario.course import Course, told_by_moments
from scenario.faults import Fault, Kind, Moment

SECOND_PRESS = Fault("bus", Kind.OFF, 0.5, 1.0, 0.5, Moment.PRESSED, 2)
EARLY = Fault("operator", Kind.STUCK, 2.25, 0.5, 0.5)


class Happening:
    """A course, and when its faults began and ended [s]."""

    def __init__(self, *faults: Fault) -> None:
        self.timeline = Timeline(1)
        self.told: list[tuple[str, str, float]] = []
        self.course = Course(self.timeline, faults, self._begin)
        self.course.meet(Moment.START)

    def until(self, at: float) -> None:
        self.timeline.run(at - self.timeline.now)

    @property
    def state(self) -> tuple[bool, bool]:
        return self.course.waits, self.course.is_under_way

    def _begin(self, fault: Fault) -> Callable[[], None]:
        self._note(fault, "begins")
        return lambda: self._note(fault, "ends")

    def _note(self, fault: Fault, what: str) -> None:
        self.told.append((fault.part, what, self.timeline.now))


def test_a_fault_follows_the_moment_that_it_tells() -> None:
    run = Happening(SECOND_PRESS, EARLY)
    for at in (1.0, 4.0, 7.0):
        run.until(at)
        run.course.meet(Moment.PRESSED)
    assert run.course.is_under_way is False
    run.until(20.0)
    assert run.told == [
        ("operator", "begins", 2.25),
        ("operator", "ends", 2.75),
        ("bus", "begins", 4.5),
        ("bus", "ends", 5.5),
    ]


def test_what_waits_and_what_is_under_way() -> None:
    run = Happening(SECOND_PRESS)
    assert run.state == (True, False)
    run.course.meet(Moment.PRESSED)
    run.course.meet(Moment.PRESSED)
    assert run.state == (False, True)
    run.until(1.4)
    assert run.state == (False, True)
    run.until(1.5)
    assert run.state == (False, False)


def test_what_is_given_up_never_happens() -> None:
    run = Happening(SECOND_PRESS)
    run.course.give_up()
    run.course.meet(Moment.PRESSED)
    run.course.meet(Moment.PRESSED)
    run.until(5.0)
    assert run.told == []
    assert not run.course.is_under_way
    assert told_by_moments(run.course) == []


def test_a_fault_is_told_by_the_last_moment_it_met() -> None:
    run = Happening(EARLY)
    for moment, at in ((Moment.PRESSED, 1.0), (Moment.PRESSED, 2.0), (Moment.DONE, 2.5)):
        run.until(at)
        run.course.meet(moment)
    run.until(5.0)
    (told,) = told_by_moments(run.course)
    assert told == Fault("operator", Kind.STUCK, 0.25, 0.5, 0.5, Moment.PRESSED, 2)
