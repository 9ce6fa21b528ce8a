"""The insertion and the rotation axis as the one thing that they are to the needle."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from needle_device_driver.axes.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.procedure import Procedure, side_by_side
from needle_device_driver.rules import Rule


@dataclasses.dataclass(frozen=True)
class PairSnapshot:
    """The newest reply of each axis."""

    insertion: AxisSnapshot
    rotation: AxisSnapshot

    @property
    def homed(self) -> bool:
        """Tell whether both axes are homed."""
        return self.insertion.homed and self.rotation.homed

    @property
    def powered(self) -> bool:
        """Tell whether both axes are able to move."""
        return self.insertion.powered and self.rotation.powered

    @property
    def ready(self) -> bool:
        """Tell whether both axes would begin to move at once."""
        return self.insertion.ready and self.rotation.ready

    @property
    def answered(self) -> bool:
        """Tell whether both axes have answered to all that they were asked."""
        return self.insertion.answered and self.rotation.answered

    @property
    def let_go(self) -> str:
        """Names of the axes that are switched off while stopped; empty: none."""
        return " and ".join(name for name, at in self.by_name.items() if at.let_go)

    def unstopped(self, oldest: float) -> str:
        """Return the axes that did not stop and switch off, or do not answer, and how.

        Parameters
        ----------
        oldest : float
            Steady time of the oldest reply that counts as an answer [s].
        """
        return "; ".join(
            f"{name} axis {at.unstopped or 'silent'}"
            for name, at in self.by_name.items()
            if at.unstopped or at.time < oldest
        )

    def age(self, now: float) -> float:
        """Return the age of the older reply [s]."""
        return now - min(self.insertion.time, self.rotation.time)

    @property
    def fault(self) -> str:
        """The faults of both axes; empty: none."""
        return "; ".join(
            f"{name} axis: {at.fault}" for name, at in self.by_name.items() if at.fault
        )

    @property
    def fault_rule(self) -> Rule:
        """The rule behind the first fault."""
        axis = self.insertion if self.insertion.fault else self.rotation
        return axis.fault_rule

    @property
    def by_name(self) -> dict[str, AxisSnapshot]:
        """Insertion and rotation, by name."""
        return {"insertion": self.insertion, "rotation": self.rotation}


class AxisPair:
    """Gives orders to both axes such that one's failure never keeps the order from the other.

    Parameters
    ----------
    insertion, rotation : Axis
        The two axes.
    """

    def __init__(self, insertion: Axis, rotation: Axis) -> None:
        self.insertion = insertion
        self.rotation = rotation

    def each(self, order: Callable[[Axis], None]) -> None:
        """Give an order to both axes.

        Raises
        ------
        AxisError
            What either raised, after both were tried.
        """
        errors: list[AxisError] = []
        for axis in (self.insertion, self.rotation):
            try:
                order(axis)
            except AxisError as error:
                errors.append(error)
        _raise_all(errors)

    def side_by_side(self, order: Callable[[Axis], Procedure[None]]) -> Procedure[None]:
        """Let both axes carry out an order at the same time; raises as `each`."""
        errors: list[AxisError] = []
        axes = self.insertion, self.rotation
        yield from side_by_side(*(_attempt(order(axis), errors) for axis in axes))
        _raise_all(errors)

    def close(self) -> Procedure[None]:
        """Let go of one axis after the other, for each sends SYNCs; raises as `each`."""
        errors: list[AxisError] = []
        for axis in (self.insertion, self.rotation):
            yield from _attempt(axis.close(), errors)
        _raise_all(errors)

    def poll(self, now: float) -> PairSnapshot:
        """Return the newest replies; `now` is the steady time [s]."""
        return PairSnapshot(self.insertion.poll(now), self.rotation.poll(now))


def _attempt(procedure: Procedure[None], errors: list[AxisError]) -> Procedure[None]:
    try:
        yield from procedure
    except AxisError as error:
        errors.append(error)


def _raise_all(errors: list[AxisError]) -> None:
    if errors:
        raise AxisError("; ".join(map(str, errors)), errors[0].rule)
