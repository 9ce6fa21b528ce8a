"""Interface of the motion supervisor to an axis, and to both axes together."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable

from needle_device_driver.procedure import Procedure, side_by_side
from needle_device_driver.rules import Rule

PERIOD = 0.02
"""Period of the control cycle [s]."""


class AxisError(Exception):
    """An axis cannot execute an order; the text names the axis and the reason.

    Parameters
    ----------
    text : str
        One sentence.
    rule : Rule
        The rule behind the error.
    """

    def __init__(self, text: str, rule: Rule = Rule.ONE_FAULT_STOPS_BOTH) -> None:
        super().__init__(text)
        self.rule = rule


@dataclasses.dataclass(frozen=True)
class AxisSnapshot:
    """The newest feedback of an axis.

    Attributes
    ----------
    time : float
        Steady time at which the feedback arrived [s].
    position : float
        Measured position [m or rad]; relative unless `homed`.
    set_point : float
        The last set-point [m or rad]. At rest it differs from `position` by the controller's
        steady-state error; on an axis without a motor they are equal.
    velocity : float
        Measured velocity [m/s or rad/s].
    powered : bool
        Whether the axis is able to move.
    homed : bool
        Whether `position` is measured from the home switch.
    moving : bool
        Whether an order (move, homing) is being executed.
    at_home_switch : bool
        Whether the home switch is active.
    at_inner_switch : bool
        Whether the limit switch at the far end is active.
    fault : str
        Reason why the axis refuses to move; empty: no fault.
    fault_rule : Rule
        The rule behind the fault.
    ready : bool
        Whether a move would begin at once; False while a powered axis comes to rest.
    answered : bool
        Whether the axis has answered all requests. Otherwise its position is too uncertain for a
        new set-point.
    released_after_block : bool
        Whether the axis was stopped while it was blocked, and is therefore switched off until the
        next order to move.
    stop_failure : str
        How the axis failed to stop: still moving or powered after its stop time; empty: it did not.
    origin : int
        Changes whenever the zero of `position` changes.
    """

    time: float
    position: float
    set_point: float
    velocity: float
    powered: bool
    homed: bool
    moving: bool
    at_home_switch: bool
    fault: str
    at_inner_switch: bool = False
    fault_rule: Rule = Rule.ONE_FAULT_STOPS_BOTH
    ready: bool = True
    answered: bool = True
    released_after_block: bool = False
    stop_failure: str = ""
    origin: int = 0


class Axis(abc.ABC):
    """One axis. Positions in m or rad, speeds in m/s or rad/s, not negative.

    A motion command returns at once; `poll` shows its progress. `configure`, `home`, `reset` and
    `close` are procedures. Every method but `poll` may raise `AxisError`.

    Attributes
    ----------
    actuated : bool
        Whether the axis has a motor; otherwise it is moved by hand and only measured.
    """

    actuated = True

    @property
    def needs_cycles(self) -> bool:
        """Whether the axis still executes an order other than a set-point."""
        return False

    @abc.abstractmethod
    def configure(self) -> Procedure[None]:
        """Set the axis up; moves nothing."""

    @abc.abstractmethod
    def power(self, on: bool) -> None:
        """Switch the axis on, holding its present position, or off; does not move it."""

    @abc.abstractmethod
    def home(self, speed: float) -> Procedure[None]:
        """Start searching for the home switch, at most at `speed`; the switch is position 0.

        The axis is not homed until it has found the switch.
        """

    @abc.abstractmethod
    def start_move(self, target: float, speed: float) -> None:
        """Move to `target` at `speed` and stop there; replaces an earlier move."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Stop as fast as possible and discard the target; `power` makes the axis ready again."""

    @abc.abstractmethod
    def reset(self) -> Procedure[None]:
        """Acknowledge a fault and wait until it clears; moves nothing."""

    @abc.abstractmethod
    def poll(self, now: float) -> AxisSnapshot:
        """Return the newest feedback at steady time `now` [s]; sends nothing and does not wait."""

    @abc.abstractmethod
    def close(self) -> Procedure[None]:
        """Stop, switch off and release the axis. May be called twice."""


@dataclasses.dataclass(frozen=True)
class PairSnapshot:
    """The newest feedback of both axes."""

    insertion: AxisSnapshot
    rotation: AxisSnapshot

    @property
    def by_name(self) -> dict[str, AxisSnapshot]:
        """Insertion and rotation, by name."""
        return {"insertion": self.insertion, "rotation": self.rotation}

    @property
    def homed(self) -> bool:
        """Whether both axes are homed."""
        return self.insertion.homed and self.rotation.homed

    @property
    def powered(self) -> bool:
        """Whether both axes are able to move."""
        return self.insertion.powered and self.rotation.powered

    @property
    def ready(self) -> bool:
        """Whether both axes would begin to move at once."""
        return self.insertion.ready and self.rotation.ready

    @property
    def answered(self) -> bool:
        """Whether both axes have answered all requests."""
        return self.insertion.answered and self.rotation.answered

    @property
    def released_after_block(self) -> str:
        """Names of the axes that are switched off after a block; empty: none."""
        return " and ".join(name for name, at in self.by_name.items() if at.released_after_block)

    def stop_failures(self, oldest: float) -> str:
        """Describe the axes that did not stop or do not answer; empty: none.

        Parameters
        ----------
        oldest : float
            Steady time of the oldest feedback that counts as an answer [s].
        """
        return "; ".join(
            f"{name} axis {at.stop_failure or 'silent'}"
            for name, at in self.by_name.items()
            if at.stop_failure or at.time < oldest
        )

    def age(self, now: float) -> float:
        """Return the age of the older feedback [s]."""
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


class AxisPair:
    """Sends orders to both axes; an error on one axis does not affect the order to the other.

    Parameters
    ----------
    insertion, rotation : Axis
        The two axes.
    """

    def __init__(self, insertion: Axis, rotation: Axis) -> None:
        self.insertion = insertion
        self.rotation = rotation

    @property
    def needs_cycles(self) -> bool:
        """Whether an axis still executes an order other than a set-point."""
        return self.insertion.needs_cycles or self.rotation.needs_cycles

    def each(self, order: Callable[[Axis], None]) -> None:
        """Send an order to both axes.

        Raises
        ------
        AxisError
            After both axes received the order, with the errors of both.
        """
        errors: list[AxisError] = []
        for axis in (self.insertion, self.rotation):
            try:
                order(axis)
            except AxisError as error:
                errors.append(error)
        _raise_all(errors)

    def side_by_side(self, order: Callable[[Axis], Procedure[None]]) -> Procedure[None]:
        """Run a procedure on both axes at the same time; raises as `each`."""
        errors: list[AxisError] = []
        axes = self.insertion, self.rotation
        yield from side_by_side(*(_collect_error(order(axis), errors) for axis in axes))
        _raise_all(errors)

    def close(self) -> Procedure[None]:
        """Close one axis after the other, because each sends its own SYNCs; raises as `each`."""
        errors: list[AxisError] = []
        for axis in (self.insertion, self.rotation):
            yield from _collect_error(axis.close(), errors)
        _raise_all(errors)

    def poll(self, now: float) -> PairSnapshot:
        """Return the newest feedback at steady time `now` [s]."""
        return PairSnapshot(self.insertion.poll(now), self.rotation.poll(now))


def _collect_error(procedure: Procedure[None], errors: list[AxisError]) -> Procedure[None]:
    try:
        yield from procedure
    except AxisError as error:
        errors.append(error)


def _raise_all(errors: list[AxisError]) -> None:
    if errors:
        raise AxisError("; ".join(map(str, errors)), errors[0].rule)
