"""Step E: every node ends in order, whatever signal comes when."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

from needle_verification.checking import Check, Finding, Workbench
from needle_verification.trials.signal_trials import Ended, signal_trials

TRIALS = 200
# A bag is completed first: last words are heard for up to a second, and a disk may be slow.
LONGEST = {"recorder": 10.0}
OTHERS_LONGEST = 1.0
_CODES = (0, 130)


def signals(bench: Workbench, trials: int = TRIALS) -> Iterator[Finding]:
    """Send SIGINT, SIGINT twice, SIGTERM or SIGHUP to all nodes at random moments."""
    for burners, key in ((0, "signals"), (2, "signals_busy")):
        folder = bench.folder / key
        folder.mkdir()
        found = list(signal_trials(folder, trials // 2, seed=burners, burners=burners))
        shutil.rmtree(folder)
        yield _finding(key, found, "both cores busy" if burners else "otherwise idle")


def _finding(key: str, found: list[Ended], load: str) -> Finding:
    slowest = {
        node: max(one.seconds for one in found if one.node == node)
        for node in sorted({one.node for one in found})
    }
    wrong = [
        f"{one.node} after {one.kind}: {one.wrong or f'exit code {one.code}'}"
        for one in found
        if one.wrong or one.code not in _CODES
    ]
    late = [node for node, s in slowest.items() if s > LONGEST.get(node, OTHERS_LONGEST)]
    times = ", ".join(f"{node} {seconds:.2f} s" for node, seconds in slowest.items())
    return Finding(
        key,
        f"signals at random moments at 2 x 30 Hz, {load}: {len(found)} ends",
        f"exit code 0 or 130, no traceback, within {OTHERS_LONGEST:g} s "
        f"(recorder {LONGEST['recorder']:g} s, its bag whole)",
        f"{len(wrong)} otherwise; slowest: {times} " + "; ".join(wrong[:3]),
        not wrong and not late,
    )


CHECKS: tuple[Check, ...] = (signals,)
