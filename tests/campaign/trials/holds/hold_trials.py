"""Losses of the hold's source at random moments of an insertion at 5 mm/s."""

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sensor_msgs.msg import Joy

from campaign.trials.holds.computers import enter_network, two_computers
from campaign.trials.holds.piped_pedal import KEY, PipedPedal
from campaign.trials.ros_rig_client import CONTROLLER_START, RosRigClient, ros
from campaign.trials.trial_processes import TrialProcesses, without_recorder
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.errors import UserError
from needle_core.process.discovery import DISCOVERY_RANGE, PROFILES, restrict_discovery
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.ros.base_node import RELIABLE, STEADY_CLOCK
from needle_core.settings.parameter_files import Parameters

CABLE = "cable_cut"
KINDS = ("pedal_unplugged", "joy_silent", "operator_frozen", CABLE)
DELAY, LOSS = 0.005, 0.01
"""Delay [s] and loss of all frames on the cable."""
OPERATOR = "operator"
_OPERATOR_MODULE = "campaign.trials.holds.piped_pedal"
_SPEED, _DEPTH_MM = 0.005, 190.0
_DEEP = 0.17  # from here on, the next trial starts a new rig [m]
_JOY_PERIOD = 0.02
# Latest loss after the begin of the motion, observation time after the return of the source, and
# time since the last motion of a moving needle [s].
_LATEST, _BACK, RECENT = 0.4, 2.0, 0.05
# Shortest and longest loss [s].
_LASTS = {CABLE: (0.3, 5.0)}
_LASTS_ELSE = (0.6, 0.6)
_NEUTRAL, _AGAIN, _GIVE_UP = 0.2, 2.0, 60.0
# Insertion that shows a motion, longer than a late stop [m].
_UNDER_WAY = 0.2e-3


class Source(NamedTuple):
    """Source of the hold, which can be pressed, lost and brought back."""

    press: Callable[[bool], None]
    lose: Callable[[], None]
    come_back: Callable[[], None]


def hold_trials(kind: str, count: int, seed: int = 1) -> list[dict[str, Any]]:
    """Return the figures of each loss; this process may enter another network.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    count : int
        Number of losses.
    seed : int
        Seed of all randomness.
    """
    rng = random.Random(f"{seed} {kind}")
    outcomes: list[dict[str, Any]] = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="needle_trial_")))
        domain = stack.enter_context(reserve_domain_id())
        cable: tuple[Callable[[], None], ...] = ()
        persons: Sequence[str] = ()
        if kind == CABLE:
            # Controller and operator are on one computer, the rig and this process on the other.
            one, other, wire = stack.enter_context(two_computers(delay=DELAY, loss=LOSS))
            enter_network(other.pid)
            # The setting of the user on both computers.
            os.environ[DISCOVERY_RANGE] = "SUBNET"
            os.environ.pop(PROFILES, None)
            restrict_discovery()
            persons, cable = one.inside, (wire.cut, wire.mend)
        stack.enter_context(ros(domain))
        while len(outcomes) < count:
            place = folder / str(len(outcomes))
            place.mkdir()
            before = dict.fromkeys((OPERATOR, "plane_controller"), persons)
            parameters = _parameters(rng.randrange(1000))
            with (
                closing(RosRigClient(holds=False)) as hand,
                closing(TrialProcesses(place, domain, parameters, before)) as graph,
                _held(kind, place, graph, hand, cable) as source,
            ):
                hand.prepare()
                hand.call_until_success(CONTROLLER_START)
                while len(outcomes) < count and hand.insertion < _DEEP:
                    outcomes.append(_lose(hand, source, rng, *_LASTS.get(kind, _LASTS_ELSE)))
                    graph.check()
    return outcomes


@contextmanager
def _held(
    kind: str,
    folder: Path,
    graph: TrialProcesses,
    hand: RosRigClient,
    cable: tuple[Callable[[], None], ...],
) -> Iterator[Source]:
    """Start an operator node, and yield the source of its hold."""
    if kind == "joy_silent":
        joy = hand.create_publisher(Joy, "joy", RELIABLE)
        pressed = [False]
        send = lambda: joy.publish(Joy(buttons=[int(pressed[0])]))  # noqa: E731
        timer = hand.create_timer(_JOY_PERIOD, send, clock=STEADY_CLOCK)
        graph.begin_module(OPERATOR, _OPERATOR_MODULE, {"source": "joy", "key": 0})
        yield Source(partial(pressed.__setitem__, 0), timer.cancel, timer.reset)
        return
    pedal = PipedPedal(folder / "pedal")
    values = {"source": "pedal", "device": str(folder / "pedal"), "key": KEY}
    graph.begin_module(OPERATOR, _OPERATOR_MODULE, values)
    ways: dict[str, tuple[Callable[[], None], ...]] = {
        "pedal_unplugged": (pedal.unplug, pedal.plug),
        "operator_frozen": (
            partial(graph.signal, OPERATOR, signal.SIGSTOP),
            partial(graph.signal, OPERATOR, signal.SIGCONT),
        ),
        CABLE: cable,
    }
    yield Source(pedal.press, *ways[kind])
    pedal.unplug()


def _lose(
    hand: RosRigClient, source: Source, rng: random.Random, shortest: float, longest: float
) -> dict[str, Any]:
    """Hold, lose the source at a random moment, bring it back unchanged, and observe."""
    again = _hold_anew(hand, source)
    hand.pause(rng.uniform(0.0, _LATEST))
    lost = time.time()
    source.lose()
    hand.pause(rng.uniform(shortest, longest))
    back = time.time()
    source.come_back()
    hand.pause(_BACK)
    return {
        "moving": hand.travelled_distance(lost - RECENT, lost) > 0.0,
        "last_motion_ms": (hand.last_motion(lost, back) - lost) * 1e3,
        "distance_mm": hand.travelled_distance(lost, back) * 1e3,
        "resumed_mm": hand.travelled_distance(back) * 1e3,
        "again_s": again,
    }


def _hold_anew(hand: RosRigClient, source: Source) -> float:
    """Press again until the needle moves; return the time that took [s].

    Raises UserError if the needle does not move.
    """
    begin = time.monotonic()
    while time.monotonic() < begin + _GIVE_UP:
        source.press(False)
        hand.pause(_NEUTRAL)
        at = hand.insertion
        source.press(True)
        again = time.monotonic() + _AGAIN
        while time.monotonic() < again:
            hand.spin(0.005)
            if hand.insertion > at + _UNDER_WAY:
                return time.monotonic() - begin
    raise UserError(f"the held needle does not move; device: {hand.status}")


def _parameters(seed: int) -> Parameters:
    """Return the parameters of a level tip with continuous insertion.

    A stepwise needle would be at rest at many losses.
    """
    parameters = without_recorder(
        SimulateOptions(
            level="tip",
            controller="paper",
            insertion="continuous",
            depth_mm=_DEPTH_MM,
            graph=True,
            seed=seed,
        )
    )
    del parameters["simulated_operator"]
    parameters["plane_controller"]["nominal_speed"] = _SPEED
    return parameters
