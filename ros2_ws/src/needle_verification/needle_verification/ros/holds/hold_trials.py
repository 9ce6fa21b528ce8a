"""Trials of what a person holds, each printed as one JSON object: when the needle moves last.

`python -m needle_verification.ros.holds.hold_trials 50 pedal_unplugged joy_silent operator_frozen`
"""

from __future__ import annotations

import json
import math
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol

import rclpy
from sensor_msgs.msg import Joy

from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_common.commands.cli import EXIT_DONE, run_command
from needle_common.commands.options import CommandParser
from needle_common.errors import UserError
from needle_common.process.ros_domain import own_domain
from needle_common.ros.base_node import STEADY_CLOCK
from needle_common.ros.conversions import RELIABLE
from needle_verification.ros.holds.hold_witness import HoldWitness
from needle_verification.trials.piped_pedal import PipedPedal
from needle_verification.trials.trial_processes import (
    Parameters,
    TrialProcesses,
    without_recorder,
)

KINDS = ("pedal_unplugged", "joy_silent", "operator_frozen")
_OPERATOR = "operator"
_PIPED = "needle_verification.ros.holds.piped_operator"
_SPEED = 0.005  # [m/s], the fastest there is
_DEPTH_MM = 190.0
_DEEP = 0.17  # from here on the next trial has a rig of its own [m]
_KEY = 48
_JOY_PERIOD = 0.02
_READY = 60.0
_NEUTRAL, _AGAIN = 0.2, 2.0
# How long a loss is watched, how long what comes back is, and the latest moment of a loss after the
# needle moves [s].
_LOST, _BACK, _LATEST = 0.6, 1.2, 0.4
# A needle that moved so shortly before moves now [s].
_RECENT = 0.05


def hold_trials(
    folder: Path, domain: int, kinds: Sequence[str], count: int, seed: int
) -> Iterator[dict[str, Any]]:
    """Yield what came of each trial: a level tip in real time, a source that is lost.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    kinds : sequence of str
        Which of `KINDS`.
    count : int
        Trials of each.
    seed : int
        Of moments and simulations.
    """
    rng = random.Random(seed)
    left = [(kind, number) for kind in kinds for number in range(count)]
    graphs = 0
    while left:
        place = folder / f"graph_{graphs}"
        place.mkdir()
        graphs += 1
        with (
            closing(HoldWitness()) as witness,
            closing(TrialProcesses(place, domain, _parameters(rng.randrange(1000)))) as graph,
        ):
            hand = _HANDS[left[0][0]](place, graph, witness)
            witness.prepare(_READY)
            kind = left[0][0]
            while left and witness.insertion < _DEEP:
                if left[0][0] != kind:
                    hand.end()
                    kind = left[0][0]
                    hand = _HANDS[kind](place, graph, witness)
                yield {"fault": kind, "number": left.pop(0)[1], **_lose(hand, witness, rng)}
                graph.check()
            hand.end()


def _lose(hand: _Hand, witness: HoldWitness, rng: random.Random) -> dict[str, Any]:
    """Hold, lose the source at a random moment, get it back as it was, and watch."""
    hold_anew(hand, witness)
    witness.pause(rng.uniform(0.0, _LATEST))
    lost = time.time()
    hand.lose()
    witness.pause(_LOST)
    back = time.time()
    hand.come_back()
    witness.pause(_BACK)
    last = witness.last_motion(lost, back)
    return {
        "moving": witness.way(lost - _RECENT, lost) > 0.0,
        "last_motion_ms": (last - lost) * 1e3,
        "distance_mm": witness.way(lost, back) * 1e3,
        "resumed_mm": witness.way(back, math.inf) * 1e3,
    }


def hold_anew(hand: Presser, witness: HoldWitness) -> None:
    """Press anew until the needle moves: what was lost must be there and neutral first.

    Parameters
    ----------
    hand : Presser
        Who presses.
    witness : HoldWitness
        Sees the needle.

    Raises
    ------
    UserError
        If it never does.
    """
    give_up = time.monotonic() + _READY
    while time.monotonic() < give_up:
        hand.release()
        witness.pause(_NEUTRAL)
        at = witness.insertion
        hand.press()
        again = time.monotonic() + _AGAIN
        while time.monotonic() < again:
            witness.look(0.005)
            if witness.insertion > at:
                return
    raise UserError(f"the held needle does not move{witness.state_now()}")


class Presser(Protocol):
    """A hand or a foot."""

    def press(self) -> None:
        """Press."""

    def release(self) -> None:
        """Let go."""


class _Hand(Presser, Protocol):
    """What a trial does to a source."""

    def lose(self) -> None: ...

    def come_back(self) -> None: ...

    def end(self) -> None: ...


class _Pedal:
    """A foot on a pedal; lost by its plug."""

    def __init__(self, folder: Path, graph: TrialProcesses, _: HoldWitness) -> None:
        path = folder / "pedal"
        self._graph = graph
        self._pedal = PipedPedal(path, _KEY)
        values = {"source": "pedal", "device": str(path), "key": _KEY}
        graph.start_module(_OPERATOR, _PIPED, values)

    def press(self) -> None:
        self._pedal.press()

    def release(self) -> None:
        self._pedal.release()

    def lose(self) -> None:
        self._pedal.unplug()

    def come_back(self) -> None:
        self._pedal.plug()

    def end(self) -> None:
        self._graph.end(_OPERATOR)
        self._pedal.unplug()


class _FrozenOperator(_Pedal):
    """A foot on a pedal, whose operator stands still and then goes on."""

    def lose(self) -> None:
        self._graph.signal(_OPERATOR, signal.SIGSTOP)

    def come_back(self) -> None:
        self._graph.signal(_OPERATOR, signal.SIGCONT)


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
        graph.start_module(_OPERATOR, _PIPED, {"source": "joy", "key": 0})

    def press(self) -> None:
        self._pressed = True

    def release(self) -> None:
        self._pressed = False

    def lose(self) -> None:
        self._silent = True

    def come_back(self) -> None:
        self._silent = False

    def end(self) -> None:
        self._timer.cancel()
        self._graph.end(_OPERATOR)


_HANDS: dict[str, Callable[[Path, TrialProcesses, HoldWitness], _Hand]] = {
    "pedal_unplugged": _Pedal,
    "joy_silent": _Joystick,
    "operator_frozen": _FrozenOperator,
}


def _parameters(seed: int) -> Parameters:
    # A needle that rests after each step would be at rest at many losses.
    options = SimulateOptions(
        level="tip",
        controller="paper",
        insertion="continuous",
        depth_mm=_DEPTH_MM,
        real_time_factor=1.0,
        seed=seed,
    )
    parameters = without_recorder(options)
    del parameters["simulated_operator"]
    parameters["plane_controller"]["nominal_speed"] = _SPEED
    return parameters


def main() -> int:
    """Run trials; returns the exit code."""
    parser = CommandParser("hold_trials", __doc__ or "", "")
    parser.add_argument("count", type=int)
    parser.add_argument("kinds", nargs="*", help=f"{', '.join(KINDS)}; all if none")
    parser.add_argument("--seed", type=int, default=1)

    def run() -> int:
        given = parser.parse_args()
        kinds = given.kinds or KINDS
        for kind in kinds:
            if kind not in KINDS:
                raise UserError(f"{kind!r} is not one of {', '.join(KINDS)}")
        with own_domain() as domain, tempfile.TemporaryDirectory(prefix="needle_trial_") as name:
            rclpy.init(args=[], domain_id=domain)
            try:
                for outcome in hold_trials(Path(name), domain, kinds, given.count, given.seed):
                    print(json.dumps(outcome), flush=True)
            finally:
                rclpy.try_shutdown()
        return EXIT_DONE

    return run_command(run)


if __name__ == "__main__":
    sys.exit(main())
