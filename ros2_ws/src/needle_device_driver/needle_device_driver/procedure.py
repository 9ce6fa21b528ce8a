"""Procedures: tasks that take several frames, as generators that yield the next wait condition.

A procedure does not block: the caller resumes it, and does other work meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

T = TypeVar("T")
_ROUNDING = 1e-9
"""Bound on the rounding error of sums of times [s]."""


@dataclass(frozen=True)
class Wait:
    """Condition for which a procedure waits, with its time-out.

    Attributes
    ----------
    until : callable
        The procedure resumes as soon as this returns true.
    seconds : float
        Time after which it resumes at the latest [s].
    """

    until: Callable[[], bool]
    seconds: float


Procedure = Generator[Wait, float, T]
"""Generator of waits; each `send` passes the steady time at which it resumes [s]."""


def run(
    procedure: Procedure[T],
    wait: Callable[[Callable[[], bool], float], Any],
    clock: Callable[[], float],
) -> T:
    """Run a procedure to its end, and block until then.

    Parameters
    ----------
    procedure : Procedure
        The procedure.
    wait : callable
        Waits until its first argument returns true, at most for the second one [s].
    clock : callable
        Returns the steady time [s].

    Returns
    -------
    object
        The result of the procedure.
    """
    running = Running(procedure)
    while not running.advance(clock()):
        wait(running.is_ready, max(running.deadline - clock(), 0.0))
    return running.result[0]


def run_at_once(procedure: Procedure[T]) -> T:
    """Run a procedure that waits for nothing, such as those of an ideal axis.

    Raises
    ------
    RuntimeError
        If it waits.
    """
    running = Running(procedure)
    if not running.advance(0.0):
        raise RuntimeError("the procedure waits, but this caller runs it in one step")
    return running.result[0]


def side_by_side(*procedures: Procedure[Any]) -> Procedure[None]:
    """Run procedures at the same time; if one raises, the others are cancelled."""
    under_way = [Running(procedure) for procedure in procedures]
    now = yield Wait(lambda: True, 0.0)
    try:
        while under_way := [running for running in under_way if not running.advance(now)]:
            deadline = min(running.deadline for running in under_way)
            # Slightly later than the deadline, so that it has passed in spite of rounding.
            seconds = deadline - now + 1.5 * _ROUNDING
            now = yield Wait(lambda: any(running.is_ready() for running in under_way), seconds)
    finally:
        for running in under_way:
            running.cancel()


class Running(Generic[T]):
    """A procedure under way.

    Parameters
    ----------
    procedure : Procedure
        The procedure.

    Attributes
    ----------
    result : list
        The result of the procedure; empty until it has ended.
    deadline : float
        Steady time at which it resumes at the latest [s].
    """

    def __init__(self, procedure: Procedure[T]) -> None:
        self.result: list[T] = []
        self._procedure = procedure
        self._wait: Wait | None = None
        self.deadline = 0.0

    def is_ready(self) -> bool:
        """Return whether the procedure can resume."""
        return self._wait is None or self._wait.until()

    def advance(self, now: float) -> bool:
        """Resume as far as possible at steady time `now` [s]; return whether it has ended."""
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
        """Cancel the procedure."""
        self._procedure.close()
