"""Step E: complete and readable bags."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

from campaign.checking import Check, Finding, Workbench, at_most, bag_read_error
from campaign.trials.recording_trials import record_and_kill, record_full_rate

DURATION = 60.0
MOMENTS = 25
PROCESSOR_SHARE, MEMORY_GROWTH_MB = 0.35, 5.0
LAST_SECONDS = 0.5


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


def killed(bench: Workbench) -> Iterator[Finding]:
    """Kill the recorder at random moments, with images and without, and recover the bag."""
    for what, argv in (("images", ()), ("small", ("small",))):
        folder = bench.folder / f"killed_{what}"
        folder.mkdir()
        whys, ages, gaps = zip(*record_and_kill(folder, MOMENTS, *argv), strict=True)
        shutil.rmtree(folder)
        why = [one for one in whys if one]
        yield Finding(
            f"killed_{what}",
            f"kill -9 at {MOMENTS} random moments, {what}, then recover",
            f"rosbags and mcap open all, at most the last {LAST_SECONDS:g} s missing, no gaps",
            f"{len(why)} do not {why[:1]}, at most {max(ages):.2f} s missing, {sum(gaps)} gaps",
            not why and max(ages) <= LAST_SECONDS and not sum(gaps),
        )


CHECKS: tuple[Check, ...] = (full_rate, killed)
