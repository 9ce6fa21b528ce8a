"""Procedures: what takes several frames, as generators that say what they wait for.

A generator does not wait itself: whoever runs it does, and may do everything else meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

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


Procedure = Generator[Wait, float, T]
"""Sent the steady time at which it goes on [s]."""


def run(
    procedure: Procedure[T],
    wait: Callable[[Callable[[], bool], float], Any],
    clock: Callable[[], float],
) -> T:
    """Run a procedure to its end.

    Parameters
    ----------
    procedure : Procedure
        What is run.
    wait : callable
        Waits until what it is given returns true, at most so long [s].
    clock : callable
        Steady time [s].

    Returns
    -------
    object
        What the procedure returns.
    """
    running = Running(procedure)
    while not running.advance(clock()):
        wait(running.is_ready, max(running.deadline - clock(), 0.0))
    return running.result[0]


def run_at_once(procedure: Procedure[T]) -> T:
    """Run a procedure that waits for nothing, such as an ideal axis has.

    Raises
    ------
    RuntimeError
        If it does wait.
    """
    running = Running(procedure)
    if not running.advance(0.0):
        raise RuntimeError("the procedure waits, and nothing here can")
    return running.result[0]


def side_by_side(*procedures: Procedure[Any]) -> Procedure[None]:
    """Run procedures at the same time; where one raises, the others end where they are."""
    under_way = [Running(procedure) for procedure in procedures]
    now = yield Wait(lambda: True, 0.0)
    try:
        while under_way := [running for running in under_way if not running.advance(now)]:
            deadline = min(running.deadline for running in under_way)
            # A hair later: then theirs is over, too.
            seconds = deadline - now + 1.5 * _ROUNDING
            now = yield Wait(lambda: any(running.is_ready() for running in under_way), seconds)
    finally:
        for running in under_way:
            running.cancel()


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
    deadline : float
        Steady time at which it goes on at the latest [s].
    """

    def __init__(self, procedure: Procedure[T]) -> None:
        self.result: list[T] = []
        self._procedure = procedure
        self._wait: Wait | None = None
        self.deadline = 0.0

    def is_ready(self) -> bool:
        """Tell whether what it waits for is there."""
        return self._wait is None or self._wait.until()

    def advance(self, now: float) -> bool:
        """Go on as far as possible at steady time `now` [s]; return whether it has ended."""
        while self.is_ready() or now >= self.deadline:
            first = self._wait is None
            try:
                self._wait = next(self._procedure) if first else self._procedure.send(now)
            except StopIteration as end:
                self.result.append(end.value)
                return True
            self.deadline = now + self._wait.seconds - _ROUNDING
        return False

    def cancel(self) -> None:
        """End it where it is; it sends nothing more."""
        self._procedure.close()
