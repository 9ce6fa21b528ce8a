"""A real driver and a whole simulation in one domain, started in any order: nothing real moves."""

from __future__ import annotations

import random
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

from needle_bringup.simulation.simulate_options import SimulateOptions
from needle_core.commands.cli import EXIT_BAD_INPUT
from needle_verification.ros.drive_hand import DriveHand
from needle_verification.trials.trial_processes import (
    Parameters,
    TrialProcesses,
    drives_and_driver,
    without_recorder,
)
from needle_verification.trials.trial_runner import Outcomes, Trial

DEVICES = ("device_driver", "sim_rig")
STARTED = (*DEVICES, "plane_controller", "simulated_operator")
_DEPTH_MM = 3.0
_START = 0.03
_LONGEST_DELAY = 5.0
_PATIENCE = 60.0
_AFTERWARDS = 0.5


def two_rigs_trials(folder: Path, domain: int, trials: Iterable[Trial]) -> Outcomes:
    """Yield what came of each trial.

    The drives are emulated and the driver is not in simulated time: it takes them for real.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Each of its own order and delays.
    """
    for trial in trials:
        yield trial.outcome(_start(trial.make_folder(folder), domain, trial.rng))


def _start(place: Path, domain: int, rng: random.Random) -> dict[str, Any]:
    order = list(STARTED)
    rng.shuffle(order)
    # Some at once, some when the others have long been there.
    delays = {name: rng.choice((0.0, rng.uniform(0.0, _LONGEST_DELAY))) for name in order}
    with (
        closing(DriveHand(steers=False)) as hand,
        closing(
            TrialProcesses(place, domain, _parameters(), started=["drive_emulator"])
        ) as processes,
    ):
        hand.until(lambda: hand.count_publishers("sim/drive_positions") > 0, "the drives")
        for name in order:
            hand.pause(delays[name])
            processes.start(name)
        hand.until(
            lambda: processes.exit_code("simulated_operator") is not None, "its end", _PATIENCE
        )
        hand.until(
            lambda: any(processes.exit_code(name) is not None for name in DEVICES),
            "the end of one device",
        )
        hand.pause(_AFTERWARDS)
        ends = {name: processes.exit_code(name) for name in order}
        said = {name: processes.log(name) for name in order}
    motors = hand.motors
    refused = [name for name in order if ends[name] == EXIT_BAD_INPUT]
    return {
        "order": " ".join(f"{name}+{delays[name]:.1f}s" for name in order),
        "moved_mm": _way([at.insertion for at in motors]) * 1e3,
        "turned_rad": _way([at.rotation for at in motors]),
        "enabled": bool(hand.real_states & {"HOLDING", "MOVING"}),
        "refused": " ".join(refused),
        # Who gives way says to whom.
        "named": any(f"/{other}" in said[name] for name in refused for other in DEVICES),
    }


def _way(positions: list[float]) -> float:
    return max(positions) - min(positions) if positions else 0.0


def _parameters() -> Parameters:
    simulation = without_recorder(SimulateOptions(level="tip", depth_mm=_DEPTH_MM, graph=True))
    return {**simulation, **drives_and_driver({"insertion_start": _START}, {})}
