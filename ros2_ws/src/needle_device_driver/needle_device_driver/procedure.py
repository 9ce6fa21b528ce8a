"""Procedures: what takes several frames, as generators that say what they wait for.

A generator does not wait itself: whoever runs it does, and may do everything else meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

T = TypeVar("T")
_ROUNDING = 1e-9
"""Of sums of times [s]."""


@dataclass(frozen=True)
class Wait:
    """Condition on which a procedure goes on, and its time-out.

    Attributes
    ----------
    until : callable
        It goes on as soon as this returns true.
    seconds : float
        It goes on after this time at the latest [s].
    """

    until: Callable[[], bool]
    seconds: float


Procedure = Generator[Wait, None, T]


class Runner(Protocol):
    """Runs a procedure to its end and returns what it returns."""

    def __call__(self, procedure: Procedure[T]) -> T:
        """Run one."""


def run(procedure: Procedure[T], wait: Callable[[Callable[[], bool], float], Any]) -> T:
    """Run a procedure to its end.

    Parameters
    ----------
    procedure : Procedure
        What is run.
    wait : callable
        Waits until what it is given returns true, at most so long [s].

    Returns
    -------
    object
        What the procedure returns.
    """
    while True:
        try:
            step = next(procedure)
        except StopIteration as end:
            result: T = end.value
            return result
        wait(step.until, step.seconds)


def run_at_once(procedure: Procedure[T]) -> T:
    """Run a procedure that waits for nothing, such as an ideal axis has.

    Raises
    ------
    RuntimeError
        If it does wait.
    """
    return run(procedure, _refuse_to_wait)


def _refuse_to_wait(_until: Callable[[], bool], _seconds: float) -> None:
    raise RuntimeError("the procedure waits, and nothing here can")


class Running(Generic[T]):
    """A procedure under way between events.

    Parameters
    ----------
    procedure : Procedure
        What is run.

    Attributes
    ----------
    result : list
        What the procedure returned; empty until it has ended.
    """

    def __init__(self, procedure: Procedure[T]) -> None:
        self.result: list[T] = []
        self._procedure = procedure
        self._wait: Wait | None = None
        self._deadline = 0.0

    def advance(self, now: float) -> bool:
        """Go on as far as possible at steady time `now` [s]; return whether it has ended."""
        while self._wait is None or self._wait.until() or now >= self._deadline:
            try:
                self._wait = next(self._procedure)
            except StopIteration as end:
                self.result.append(end.value)
                return True
            self._deadline = now + self._wait.seconds - _ROUNDING
        return False

    def cancel(self) -> None:
        """End it where it is; it sends nothing more."""
        self._procedure.close()
