"""kill -9 of a node while the needle is steered: how the motion ends, and how it goes on."""

from __future__ import annotations

import random
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from campaign.trials.drives.drive_hand import DriveHand
from campaign.trials.trial_processes import TrialProcesses, graph_in_real_time
from campaign.trials.trial_runner import Outcomes, Trial
from needle_core.ros.conversions import LATCHED, values_of

KILLED = ("plane_controller", "stereo_tracker", "simulated_operator")
_READY = 120.0
_WATCHED = 3.0
_STILL = 1.0
_RESUMED = 60.0
_DEEP_ENOUGH = 0.002


def kill_trials(folder: Path, domain: int, trials: Iterable[Trial]) -> Outcomes:
    """Yield what came of each trial, in real time, each with a graph of its own.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Their kinds are the nodes of `KILLED`.
    """
    for trial in trials:
        parameters = graph_in_real_time(trial.rng.randrange(1000))
        with (
            closing(DriveHand(steers=False)) as hand,
            closing(TrialProcesses(trial.make_folder(folder), domain, parameters)) as graph,
        ):
            yield trial.outcome(_kill(graph, hand, trial.kind, trial.rng))


def _kill(graph: TrialProcesses, hand: DriveHand, kind: str, rng: random.Random) -> dict[str, Any]:
    controller: dict[str, str] = {}

    def on_controller(message: DiagnosticStatus) -> None:
        controller.update(values_of(message))

    hand.create_subscription(DiagnosticStatus, "needle/controller_status", on_controller, LATCHED)
    hand.until(
        lambda: bool(hand.motors) and hand.motors[-1].insertion > _DEEP_ENOUGH, "steering", _READY
    )
    graph.check()
    hand.pause(rng.uniform(0.0, 2.0))
    before = hand.motors[-1]
    graph.kill(kind)
    hand.pause(_WATCHED)
    stopped = hand.motors[-1]
    distance = stopped.insertion - before.insertion
    state, reason = hand.status.get("state", ""), hand.status.get("reason", "")
    controller_says = f"{controller.get('state')}: {controller.get('reason')}"
    still_from = len(hand.motors)
    hand.pause(_STILL)
    moved = max(abs(at.insertion - stopped.insertion) for at in hand.motors[still_from:])
    # On it goes only by a new press of the hold, or by the node that was missing.
    if kind == "simulated_operator":
        hand.press()
    elif kind == "stereo_tracker":
        graph.start(kind)
    else:
        # A controller that begins anew wants the needle out.
        hand.insist("retract")
        hand.until(lambda: hand.status.get("activity") == "none", "retracted", _READY)
        stopped = hand.motors[-1]
        # To the others a killed node lives on until its lease ends, and two senders are too many.
        hand.until(
            lambda: hand.count_publishers("device/joint_trajectory") == 0, "its lease", _READY
        )
        graph.start(kind)
        graph.restart("simulated_operator")
    hand.until(
        lambda: hand.motors[-1].insertion > stopped.insertion + 1e-4, "steering again", _RESUMED
    )
    return {
        "distance_mm": distance * 1e3,
        "state": state,
        "reason": reason,
        "controller": controller_says,
        "moved_by_itself_mm": moved * 1e3,
    }
