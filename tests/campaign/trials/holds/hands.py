"""Hands and feet that hold a needle which moves all the time, each with an operator of its own."""

from __future__ import annotations

import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

from sensor_msgs.msg import Joy

from campaign.trials.holds.hold_witness import HoldWitness
from campaign.trials.holds.piped_pedal import PipedPedal
from campaign.trials.trial_processes import (
    Parameters,
    TrialProcesses,
    without_recorder,
)
from campaign.trials.trial_runner import Trial
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.errors import UserError
from needle_core.ros.base_node import STEADY_CLOCK
from needle_core.ros.conversions import RELIABLE

OPERATOR = "operator"
READY = 60.0
"""How long a rig may take to be ready, and a needle to move [s]."""

LATEST = 0.4
"""Latest moment of a loss after the needle has begun to move [s]."""

RECENT = 0.05
"""A needle that moved so shortly before moves now [s]."""

_PIPED = "campaign.trials.holds.piped_operator"
_SPEED = 0.005  # [m/s], the fastest there is
_DEPTH_MM = 190.0
_DEEP = 0.17  # from here on the next trial has a rig of its own [m]
_KEY = 48
_JOY_PERIOD = 0.02
_NEUTRAL, _AGAIN = 0.2, 2.0
# A needle that goes farther than a late stop or settling drives would take it moves [m].
_UNDER_WAY = 0.2e-3


class HeldSource(Protocol):
    """Presses a source that can be lost."""

    def press(self) -> None:
        """Press."""

    def release(self) -> None:
        """Let go."""

    def lose(self) -> None:
        """Lose the source."""

    def come_back(self) -> None:
        """Get it back as it was."""

    def close(self) -> None:
        """End it and its operator."""


class PedalFoot(PipedPedal):
    """A foot on a pedal; lost by its plug."""

    def __init__(self, folder: Path, graph: TrialProcesses, _: HoldWitness) -> None:
        path = folder / "pedal"
        super().__init__(path, _KEY)
        self._graph = graph
        values = {"source": "pedal", "device": str(path), "key": _KEY}
        graph.start_module(OPERATOR, _PIPED, values)

    def lose(self) -> None:
        """Pull the plug."""
        self.unplug()

    def come_back(self) -> None:
        """Plug it in."""
        self.plug()

    def close(self) -> None:
        """End the operator, and take the pedal away."""
        self._graph.end(OPERATOR)
        self.unplug()


class _FrozenOperator(PedalFoot):
    """A foot on a pedal, whose operator stands still and then goes on."""

    def lose(self) -> None:
        self._graph.signal(OPERATOR, signal.SIGSTOP)

    def come_back(self) -> None:
        self._graph.signal(OPERATOR, signal.SIGCONT)


class _Joystick:
    """A hand on a joystick behind the topic joy; lost by its silence."""

    def __init__(self, _: Path, graph: TrialProcesses, witness: HoldWitness) -> None:
        self._graph = graph
        self._pressed = self._silent = False
        joy = witness.create_publisher(Joy, "joy", RELIABLE)

        def send() -> None:
            if not self._silent:
                joy.publish(Joy(axes=[], buttons=[int(self._pressed)]))

        self._timer = witness.create_timer(_JOY_PERIOD, send, clock=STEADY_CLOCK)
        graph.start_module(OPERATOR, _PIPED, {"source": "joy", "key": 0})

    def press(self) -> None:
        self._pressed = True

    def release(self) -> None:
        self._pressed = False

    def lose(self) -> None:
        self._silent = True

    def come_back(self) -> None:
        self._silent = False

    def close(self) -> None:
        self._timer.cancel()
        self._graph.end(OPERATOR)


HANDS: Mapping[str, Callable[[Path, TrialProcesses, HoldWitness], HeldSource]] = {
    "pedal_unplugged": PedalFoot,
    "joy_silent": _Joystick,
    "operator_frozen": _FrozenOperator,
}


def hold_anew(hand: HeldSource, witness: HoldWitness) -> None:
    """Press anew until the needle moves: what was lost must be there and neutral first.

    Parameters
    ----------
    hand : HeldSource
        Who presses.
    witness : HoldWitness
        Sees the needle.

    Raises
    ------
    UserError
        If it never does.
    """
    give_up = time.monotonic() + READY
    while time.monotonic() < give_up:
        hand.release()
        witness.pause(_NEUTRAL)
        at = witness.insertion
        hand.press()
        again = time.monotonic() + _AGAIN
        while time.monotonic() < again:
            witness.look(0.005)
            if witness.insertion > at + _UNDER_WAY:
                return
    raise UserError(f"the held needle does not move{witness.state_now()}")


def until_deep(trials: deque[Trial], witness: HoldWitness) -> Iterator[Trial]:
    """Take trials from those that are left, until the needle is so deep that it wants a new rig."""
    while trials and witness.insertion < _DEEP:
        yield trials.popleft()


def fast_insertion(seed: int = 1) -> Parameters:
    """Return the parameters of a level tip in real time, whose needle moves as long as it is held.

    One that rests after each step would be at rest at many losses.

    Parameters
    ----------
    seed : int, optional
        Of the simulation.
    """
    options = SimulateOptions(
        level="tip",
        controller="paper",
        insertion="continuous",
        depth_mm=_DEPTH_MM,
        graph=True,
        seed=seed,
    )
    parameters = without_recorder(options)
    del parameters["simulated_operator"]
    parameters["plane_controller"]["nominal_speed"] = _SPEED
    return parameters
