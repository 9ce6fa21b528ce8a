"""Trials of what a person holds, each printed as one JSON object: when the needle moves last.

`python -m campaign.trials.holds.hold_trials 50 pedal_unplugged joy_silent operator_frozen`
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections import deque
from collections.abc import Iterable
from contextlib import closing
from itertools import groupby
from pathlib import Path
from typing import Any

from campaign.trials.holds.hands import (
    HANDS,
    LATEST,
    READY,
    RECENT,
    HeldSource,
    fast_insertion,
    hold_anew,
    until_deep,
)
from campaign.trials.holds.hold_witness import HoldWitness
from campaign.trials.listening_node import ros
from campaign.trials.trial_processes import TrialProcesses
from campaign.trials.trial_runner import Outcomes, Trial, run_trials, trials_of
from needle_core.commands.options import CommandParser

KINDS = tuple(HANDS)
# How long a loss is watched, and how long what comes back is [s].
_LOST, _BACK = 0.6, 1.2


def hold_trials(folder: Path, domain: int, trials: Iterable[Trial]) -> Outcomes:
    """Yield what came of each trial: a level tip in real time, a source that is lost.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Their kinds are of `KINDS`.
    """
    left = deque(trials)
    with ros(domain):
        while left:
            place = left[0].make_folder(folder)
            parameters = fast_insertion(left[0].rng.randrange(1000))
            with (
                closing(HoldWitness()) as witness,
                closing(TrialProcesses(place, domain, parameters)) as graph,
            ):
                ready = False
                for kind, alike in groupby(until_deep(left, witness), lambda trial: trial.kind):
                    with closing(HANDS[kind](place, graph, witness)) as hand:
                        # A simulated rig waits for an operator, whichever.
                        if not ready:
                            witness.prepare(READY)
                            ready = True
                        for trial in alike:
                            yield trial.outcome(_lose(hand, witness, trial.rng))
                            graph.check()


def _lose(hand: HeldSource, witness: HoldWitness, rng: random.Random) -> dict[str, Any]:
    """Hold, lose the source at a random moment, get it back as it was, and watch."""
    hold_anew(hand, witness)
    witness.pause(rng.uniform(0.0, LATEST))
    lost = time.time()
    hand.lose()
    witness.pause(_LOST)
    back = time.time()
    hand.come_back()
    witness.pause(_BACK)
    last = witness.last_motion(lost, back)
    return {
        "moving": witness.way(lost - RECENT, lost) > 0.0,
        "last_motion_ms": (last - lost) * 1e3,
        "distance_mm": witness.way(lost, back) * 1e3,
        "resumed_mm": witness.way(back, math.inf) * 1e3,
        "silent_ms": witness.longest_silence(lost - RECENT, math.inf) * 1e3,
    }


def main() -> int:
    """Run trials; returns the exit code."""
    return run_trials(
        CommandParser("hold_trials", __doc__ or "", ""),
        lambda given, folder, domain: hold_trials(
            folder, domain, trials_of(KINDS, given.kinds, given.count, given.seed)
        ),
    )


if __name__ == "__main__":
    sys.exit(main())
