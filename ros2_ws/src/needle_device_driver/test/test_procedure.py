"""Procedures between events: they go on when what they wait for is there, or its time is over."""

from __future__ import annotations

import pytest

from needle_device_driver.procedure import Procedure, Running, Wait, run, run_at_once


class Script:
    """A procedure of two waits, and how far it got."""

    def __init__(self) -> None:
        self.is_there = False
        self.steps: list[str] = []

    def procedure(self) -> Procedure[str]:
        try:
            self.steps.append("first")
            yield Wait(lambda: self.is_there, 0.5)
            self.steps.append("second")
            yield Wait(lambda: False, 0.1)
            return "done"
        finally:
            self.steps.append("end")


def test_it_goes_on_when_what_it_waits_for_is_there_or_its_time_is_over() -> None:
    script = Script()
    running = Running(script.procedure())
    assert script.steps == []
    assert not running.advance(10.0)
    assert not running.advance(10.4)
    assert script.steps == ["first"]
    script.is_there = True
    assert not running.advance(10.45)
    assert script.steps == ["first", "second"]
    assert not running.advance(10.54)
    assert running.advance(10.55)
    assert running.result == ["done"]


def test_the_first_wait_ends_in_time_too() -> None:
    script = Script()
    running = Running(script.procedure())
    running.advance(0.0)
    # 25 periods of 0.02 s make no more than 0.5 s, however they are rounded
    running.advance(sum([0.02] * 25))
    assert script.steps == ["first", "second"]


def test_one_that_is_cancelled_does_nothing_more() -> None:
    script = Script()
    running = Running(script.procedure())
    running.advance(0.0)
    running.cancel()
    assert script.steps == ["first", "end"]
    assert running.result == []


def test_run_waits_for_it_and_run_at_once_refuses_to() -> None:
    waits: list[float] = []
    assert run(Script().procedure(), lambda until, seconds: waits.append(seconds)) == "done"
    assert waits == [0.5, 0.1]
    with pytest.raises(RuntimeError, match="the procedure waits"):
        run_at_once(Script().procedure())
