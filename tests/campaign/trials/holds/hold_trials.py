"""Losses of the operator node at random moments of an insertion at 5 mm/s."""

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from campaign.trials.holds.computers import Cable, enter_network, two_computers
from campaign.trials.holds.piped_pedal import KEY, PipedPedal
from campaign.trials.ros_rig_client import CONTROLLER_START, RosRigClient, ros
from campaign.trials.trial_processes import TrialProcesses, without_recorder
from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.errors import UserError
from needle_core.process.discovery import DISCOVERY_RANGE, PROFILES, restrict_discovery
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.settings.parameter_files import Parameters

CABLE = "cable_cut"
FROZEN = "operator_frozen"
DELAY, LOSS = 0.005, 0.01
"""Delay [s] and loss of all frames on the cable."""
OPERATOR = "operator"
_OPERATOR_MODULE = "campaign.trials.holds.piped_pedal"
_SPEED, _DEPTH_MM = 0.005, 190.0
_DEEP = 0.17  # from here on, the next trial starts a new rig [m]
# Latest loss after the start of the motion, observation time after the return of the source, and
# time since the last motion of a moving needle [s].
_LATEST, _BACK, RECENT = 0.4, 2.0, 0.05
# Shortest and longest loss [s].
_FROZEN_FOR, _CUT_FOR = (0.6, 0.6), (0.3, 5.0)
_NEUTRAL, _AGAIN, _GIVE_UP = 0.2, 2.0, 60.0
# Insertion that shows a motion, longer than a late stop [m].
_UNDER_WAY = 0.2e-3


def hold_trials(kind: str, count: int, seed: int = 1) -> list[dict[str, Any]]:
    """Return the figures of each loss; this process may enter another network.

    Parameters
    ----------
    kind : str
        `FROZEN` or `CABLE`.
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
        cable: Cable | None = None
        persons: Sequence[str] = ()
        if kind == CABLE:
            # Controller and operator are on one computer, the rig and this process on the other.
            one, other, cable = stack.enter_context(two_computers(delay=DELAY, loss=LOSS))
            enter_network(other.pid)
            # The setting of the user on both computers.
            os.environ[DISCOVERY_RANGE] = "SUBNET"
            os.environ.pop(PROFILES, None)
            restrict_discovery()
            persons = one.inside
        stack.enter_context(ros(domain))
        while len(outcomes) < count:
            trial = folder / str(len(outcomes))
            trial.mkdir()
            pedal = PipedPedal(trial / "pedal")
            before = dict.fromkeys((OPERATOR, "plane_controller"), persons)
            parameters = _parameters(rng.randrange(1000))
            with (
                closing(pedal),
                closing(RosRigClient(holds=False)) as hand,
                closing(TrialProcesses(trial, domain, parameters, before)) as graph,
            ):
                values = {"source": "pedal", "device": str(trial / "pedal"), "key": KEY}
                graph.begin_module(OPERATOR, _OPERATOR_MODULE, values)
                loss, duration = partial(_frozen, graph), _FROZEN_FOR
                if cable is not None:
                    loss, duration = partial(_cut, cable), _CUT_FOR
                hand.prepare()
                hand.call_until_success(CONTROLLER_START)
                while len(outcomes) < count and hand.insertion < _DEEP:
                    outcomes.append(_lose(hand, pedal, loss, rng, duration))
                    graph.check()
    return outcomes


@contextmanager
def _frozen(graph: TrialProcesses) -> Iterator[None]:
    graph.signal(OPERATOR, signal.SIGSTOP)
    yield
    graph.signal(OPERATOR, signal.SIGCONT)


@contextmanager
def _cut(cable: Cable) -> Iterator[None]:
    cable.cut()
    yield
    cable.mend()


def _lose(
    hand: RosRigClient,
    pedal: PipedPedal,
    loss: Callable[[], AbstractContextManager[None]],
    rng: random.Random,
    duration: tuple[float, float],
) -> dict[str, Any]:
    """Hold, lose the operator at a random moment, bring it back with the pedal down, and observe.

    Parameters
    ----------
    hand : RosRigClient
        Records the motion.
    pedal : PipedPedal
        The operator's pedal.
    loss : callable
        Returns a context in which the operator is lost.
    rng : random.Random
        Source of the moments.
    duration : tuple of float
        Shortest and longest loss [s].
    """
    again = _hold_anew(hand, pedal)
    hand.pause(rng.uniform(0.0, _LATEST))
    lost = time.time()
    with loss():
        hand.pause(rng.uniform(*duration))
        back = time.time()
    hand.pause(_BACK)
    return {
        "moving": hand.travelled_distance(lost - RECENT, lost) > 0.0,
        "last_motion_ms": (hand.last_motion(lost, back) - lost) * 1e3,
        "distance_mm": hand.travelled_distance(lost, back) * 1e3,
        "resumed_mm": hand.travelled_distance(back) * 1e3,
        "again_s": again,
    }


def _hold_anew(hand: RosRigClient, pedal: PipedPedal) -> float:
    """Press again until the needle moves; return the time that took [s].

    Raises UserError if the needle does not move.
    """
    begin = time.monotonic()
    while time.monotonic() < begin + _GIVE_UP:
        pedal.press(False)
        hand.pause(_NEUTRAL)
        at = hand.insertion
        pedal.press(True)
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
