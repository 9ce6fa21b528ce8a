"""Trials of the console's hold in a real browser, each printed as one JSON object.

`python -m campaign.trials.console.console_trials 50 closed stalled`: a needle moves at
5 mm/s while a page's button or the space bar is held; then, at a random moment, the page is closed,
and so on.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

from campaign.trials.console.console_losses import LOSSES, Loss
from campaign.trials.console.console_scene import Scene
from campaign.trials.listening_node import ros
from campaign.trials.trial_runner import Outcomes, Trial, run_trials, trials_of
from needle_core.commands.options import CommandParser

# Later motion began anew [ms].
RESUMED_MS = 500.0
# How long the needle has moved before the loss [s].
_MOVES_BEFORE = 0.1, 0.9


def console_trials(folder: Path, domain: int, trials: Iterable[Trial]) -> Outcomes:
    """Yield what came of each trial, all with one rig.

    Parameters
    ----------
    folder : Path
        Takes profiles and logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Their kinds are of `LOSSES`.
    """
    with ros(domain), closing(Scene(folder, domain)) as scene:
        for trial in trials:
            scene.rng = trial.rng
            yield trial.outcome(_lose(scene, LOSSES[trial.kind]))


def _lose(scene: Scene, lose: Loss) -> dict[str, Any]:
    hand = scene.hand
    lost_before = scene.press_until(scene.rng.uniform(*_MOVES_BEFORE))
    seen = len(hand.moves)
    before = hand.insertion
    begun_ns = time.time_ns()
    lost_at_ns = lose(scene) or begun_ns
    # What had moved before may be heard only now.
    times_ms = [(move.sent_ns - lost_at_ns) * 1e-6 for move in hand.moves[seen:]]
    return {
        "pressed_by": scene.by,
        "lost_before": lost_before,
        "last_motion_ms": max([0.0, *times_ms]),
        "way_mm": (hand.insertion - before) * 1e3,
        "resumed": any(at_ms > RESUMED_MS for at_ms in times_ms),
        "state": hand.status.get("state", ""),
    }


def main() -> int:
    """Run trials; returns the exit code."""
    return run_trials(
        CommandParser("console_trials", __doc__ or "", ""),
        lambda given, folder, domain: console_trials(
            folder, domain, trials_of(tuple(LOSSES), given.kinds, given.count, given.seed)
        ),
    )


if __name__ == "__main__":
    sys.exit(main())
