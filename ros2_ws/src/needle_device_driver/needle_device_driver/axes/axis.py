"""Interface of the motion supervisor to an axis, whatever moves it."""

from __future__ import annotations

import abc
import dataclasses

from needle_device_driver.procedure import Procedure
from needle_device_driver.rules import Rule


class AxisError(Exception):
    """An axis could not take an order; the text says which axis and why.

    Parameters
    ----------
    text : str
        One sentence.
    rule : Rule
        The rule behind it.
    """

    def __init__(self, text: str, rule: Rule = Rule.ONE_FAULT_STOPS_BOTH) -> None:
        super().__init__(text)
        self.rule = rule


@dataclasses.dataclass(frozen=True)
class AxisSnapshot:
    """The last that an axis said about itself.

    Attributes
    ----------
    time : float
        When the reply arrived, on the steady clock [s].
    position : float
        Measured position [m or rad]; only relative while not `homed`.
    set_point : float
        Where it was last told to be, counted like `position`; at rest they differ by what the axis'
        controller leaves over. Of an axis that a hand moves: `position`.
    velocity : float
        Measured velocity [m/s or rad/s].
    powered : bool
        Whether the axis is able to move.
    homed : bool
        Whether `position` counts from the home switch.
    moving : bool
        Whether an order (move, homing) is under way.
    at_home_switch : bool
        Whether the home switch is touched.
    at_inner_switch : bool
        Whether the limit switch at the far end is touched.
    fault : str
        Why the axis refuses to move; empty: no fault.
    fault_rule : Rule
        The rule behind the fault.
    ready : bool
        Whether a move would begin at once: not while a powered axis still comes to rest.
    answered : bool
        Whether the axis has answered to all that it was asked: until then, where it is is not known
        well enough to send it on.
    let_go : bool
        Whether a stopped axis is switched off until the next order to move, since it was blocked
        short of where its controller wants it.
    unstopped : str
        State of an axis that should have stopped and switched off long ago; empty: it did.
    origin : int
        Changes whenever `position` begins to count from elsewhere.
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
    let_go: bool = False
    unstopped: str = ""
    origin: int = 0


class Axis(abc.ABC):
    """One axis. Positions in m or rad, speeds in m/s or rad/s, never negative.

    No order that moves waits until it is carried out; `poll` tells. `configure`, `home`, `reset`
    and `close` are procedures: they take several frames, and do nothing before they are run. Any
    may raise `AxisError`.

    Attributes
    ----------
    actuated : bool
        Whether the axis moves by itself; one that a hand moves only says where it is.
    """

    actuated = True

    @abc.abstractmethod
    def configure(self) -> Procedure[None]:
        """Set the axis up; moves nothing."""

    @abc.abstractmethod
    def power(self, on: bool) -> None:
        """Switch the axis on, its target being where it comes to rest, or off; moves nothing."""

    @abc.abstractmethod
    def home(self, speed: float) -> Procedure[None]:
        """Start to look for the home switch, at most at `speed`; position 0 is there.

        The axis is not homed from the order on until the switch is found.
        """

    @abc.abstractmethod
    def start_move(self, target: float, speed: float) -> None:
        """Go to `target` at `speed` and end there by itself; replaces the move before."""

    @abc.abstractmethod
    def stop(self) -> None:
        """Stop as fast as the axis can and forget the target; `power` makes it ready again."""

    @abc.abstractmethod
    def reset(self) -> Procedure[None]:
        """Acknowledge a fault and wait for the axis' answer; moves nothing."""

    @abc.abstractmethod
    def poll(self, now: float) -> AxisSnapshot:
        """Return the newest reply; `now` is the steady time [s]. Sends and waits for nothing."""

    @abc.abstractmethod
    def close(self) -> Procedure[None]:
        """Stop, switch off and let go of the link. May be called twice."""
