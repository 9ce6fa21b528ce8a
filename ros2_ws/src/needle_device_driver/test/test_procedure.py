"""Procedures: conditions, time-outs, cancellation."""

from __future__ import annotations

import pytest

from needle_device_driver.procedure import Procedure, Running, Wait, run_at_once, side_by_side


class Script:
    """A procedure of two waits that records its progress."""

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


def test_procedure_resumes_by_condition_or_time_out() -> None:
    script = Script()
    running = Running(script.procedure())
    assert not running.advance(10.0)
    assert not running.advance(10.4)
    assert script.steps == ["first"]
    script.is_there = True
    assert not running.advance(10.45)
    assert script.steps == ["first", "second"]
    # 5 periods of 0.02 s are at most 0.1 s in spite of rounding.
    assert not running.advance(10.54)
    assert running.advance(10.45 + sum([0.02] * 5))
    assert running.result == ["done"]


def test_run_at_once_refuses_to_wait() -> None:
    with pytest.raises(RuntimeError, match="the procedure waits"):
        run_at_once(Script().procedure())


# ---- side by side ------------------------------------------------------------------------------


def test_side_by_side_procedures_are_independent() -> None:
    one, other = Script(), Script()
    running = Running(side_by_side(one.procedure(), other.procedure()))
    running.advance(0.0)
    other.is_there = True
    assert not running.advance(0.1)
    assert (one.steps, other.steps) == (["first"], ["first", "second"])
    assert not running.advance(0.2)
    assert other.steps == ["first", "second", "end"]
    assert not running.advance(0.5)
    assert running.advance(0.6)
    assert one.steps == ["first", "second", "end"]


def test_side_by_side_an_error_cancels_the_others() -> None:
    def refused() -> Procedure[None]:
        yield Wait(lambda: False, 0.1)
        raise ValueError("refused")

    one = Script()
    running = Running(side_by_side(one.procedure(), refused()))
    running.advance(0.0)
    with pytest.raises(ValueError, match="refused"):
        running.advance(0.1)
    assert one.steps == ["first", "end"]


def test_cancellation_ends_each_procedure_side_by_side() -> None:
    scripts = Script(), Script()
    running = Running(side_by_side(*(script.procedure() for script in scripts)))
    running.advance(0.0)
    running.cancel()
    assert [script.steps for script in scripts] == [["first", "end"]] * 2
