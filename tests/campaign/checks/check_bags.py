"""Step E: complete and readable bags, and clean exits of all nodes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

from campaign.checking import Check, Finding, Workbench, at_most, bag_read_error
from campaign.trials.recording_trials import record_full_rate
from campaign.trials.signal_trials import signal_trials

DURATION = 60.0
PROCESSOR_SHARE, MEMORY_GROWTH_MB = 0.35, 5.0
SIGNALS = 100
# Longest time to exit [s]. The recorder first receives late messages for up to a second and
# completes its bag; for other nodes, launchers send SIGTERM after 5 s.
LONGEST_END, LONGEST_END_OF_OTHERS = {"recorder": 10.0}, 5.0


def full_rate(bench: Workbench) -> Iterator[Finding]:
    """Record stereo at 2 x 30 Hz with all other topics while both cores are busy."""
    measured = record_full_rate(bench.folder, DURATION)
    missing, counted = measured["missing"], measured["counted"]
    yield Finding(
        "full_rate_missing",
        f"{measured['sent']} messages in {DURATION:.0f} s, both cores busy: missing, counted",
        "0, counted at the source, and just those that the recorder counts",
        f"{missing or 0}, {counted or 0} ({measured['MB_per_s']:.0f} MB/s)",
        not missing and not counted and measured["code"] == 0,
    )
    what = "the recorder's processor time, of a core"
    yield at_most("full_rate_processor", what, PROCESSOR_SHARE, measured["share"], form=".1%")
    what = f"growth of the recorder's memory ({measured['memory']:.0f} MB) in the second half"
    yield at_most("full_rate_memory", what, MEMORY_GROWTH_MB, measured["grew"], " MB")
    why = bag_read_error(bench.folder / "full_rate")
    yield Finding("full_rate_readers", "rosbags and mcap", "read all", why or "read all", not why)


def signals(bench: Workbench) -> Iterator[Finding]:
    """Send SIGINT, SIGINT twice, SIGTERM or SIGHUP to all nodes at random moments."""
    for burners in (0, 2):
        folder = bench.folder / f"signals_{burners}"
        folder.mkdir()
        found = list(signal_trials(folder, SIGNALS, burners))
        shutil.rmtree(folder)
        slowest: dict[str, float] = {}
        for one in found:
            slowest[one.node] = max(one.seconds, slowest.get(one.node, 0.0))
        late = {n for n, s in slowest.items() if s > LONGEST_END.get(n, LONGEST_END_OF_OTHERS)}
        wrong = [f"{one.node} after {one.when}: {one.wrong}" for one in found if one.wrong]
        times = ", ".join(f"{node} {seconds:.2f} s" for node, seconds in sorted(slowest.items()))
        yield Finding(
            f"signals_{'busy' if burners else 'idle'}",
            f"signals at random moments at 2 x 30 Hz beside {burners} others: {len(found)} ends",
            f"exit code 0 or 130, no traceback, within {LONGEST_END_OF_OTHERS:g} s "
            f"(recorder {LONGEST_END['recorder']:g} s, its bag whole)",
            "; ".join([f"{len(wrong)} otherwise", f"slowest: {times}", *wrong[:3]]),
            not wrong and not late,
        )


CHECKS: tuple[Check, ...] = (full_rate, signals)
