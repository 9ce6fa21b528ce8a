"""Trials of the console's hold in a real browser, each printed as one JSON object.

`python -m needle_verification.ros.console.console_trials 50 closed stalled`: a needle moves at
5 mm/s while a page's button or the space bar is held; then, at a random moment, the page is closed,
and so on. `... 5 hostile`: other pages try all that they should not.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from needle_core.commands.options import CommandParser
from needle_core.errors import UserError
from needle_verification.ros.console.console_losses import LOSSES, Loss, let_go
from needle_verification.ros.console.console_scene import Scene
from needle_verification.ros.listening_node import ros
from needle_verification.trials.button_page import TOKEN
from needle_verification.trials.trial_runner import Outcomes, Trial, run_trials, trials_of

HOSTILE = "hostile"
KINDS = (*LOSSES, HOSTILE)

# Later motion began anew [ms].
RESUMED_MS = 500.0
# How long the needle has moved before the loss [s]; among hostile pages no hold lasts for long.
_MOVES_BEFORE, _AMONG_HOSTILE = (0.1, 0.9), (0.05, 0.15)
_REPLAYED = 0.3
_REPLAYS, _BETWEEN_REPLAYS = 10, 0.3


def console_trials(folder: Path, domain: int, trials: Iterable[Trial]) -> Outcomes:
    """Yield what came of each trial, all with one rig.

    Parameters
    ----------
    folder : Path
        Takes profiles and logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Their kinds are of `KINDS`.
    """
    with ros(domain), closing(Scene(folder, domain)) as scene:
        for trial in trials:
            scene.rng = trial.rng
            yield trial.outcome(
                _among_hostile_pages(scene)
                if trial.kind == HOSTILE
                else _lose(scene, LOSSES[trial.kind], _MOVES_BEFORE)
            )


def _among_hostile_pages(scene: Scene) -> dict[str, Any]:
    """Look that nobody else moves the needle, then that the right page's person can let go."""
    # Something to replay.
    scene.press_until(_REPLAYED)
    scene.release()
    with _hostile_pages(scene.console.ports):
        # What had moved before may be heard only now.
        since_ns = time.time_ns()
        for _ in range(_REPLAYS):
            scene.proxy.replay()
            scene.hand.pause(_BETWEEN_REPLAYS)
        moved = scene.hand.moves[-1].sent_ns > since_ns
        outcome = _lose(scene, let_go, _AMONG_HOSTILE)
    return {**outcome, "moved_by_others": moved, "refused": scene.console.refusals()}


@contextlib.contextmanager
def _hostile_pages(ports: Mapping[str, int]) -> Iterator[None]:
    words = ["-m", "needle_verification.trials.hostile_pages"]
    known = [str(ports["page"]), str(ports["hold"]), TOKEN]
    # They would have a machine of their own.
    command = ["nice", "-n", "19", sys.executable, *words, *known]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        yield
        if process.poll() is not None:
            raise UserError("the hostile pages have given up")
    finally:
        process.kill()
        process.wait()


def _lose(scene: Scene, lose: Loss, moves: tuple[float, float]) -> dict[str, Any]:
    hand = scene.hand
    lost_before = scene.press_until(scene.rng.uniform(*moves))
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
            folder, domain, trials_of(KINDS, given.kinds, given.count, given.seed)
        ),
    )


if __name__ == "__main__":
    sys.exit(main())
