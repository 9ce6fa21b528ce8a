"""Check that MCAP files are of one recording, by their times and by the recorder's records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final

from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory
from needle_core.files.bag_records import RUN_RECORD

_SECOND: Final = 10**9
# A file begins so long before or after the one before it ends [ns] at most: its first message is
# the next that came, and may have overtaken a last one.
_OVERLAP, _PAUSE = _SECOND, 60 * _SECOND
# Custom data that stay the same all through a recording.
_OF_RUN: Final = ("commit", "run_info")


def require_one_recording(files: Sequence[BagDirectory], behind: Sequence[BagDirectory]) -> None:
    """Raise a `UserError` if files, in order, are not of one recording.

    Parameters
    ----------
    files : sequence of BagDirectory
        None is missing between these.
    behind : sequence of BagDirectory
        Some may be missing before and between these.
    """
    custom = files[0].custom_data
    for before, file in pairwise((*files, *behind)):
        pause = file.start - before.end if file.start and before.end else 0
        if any(r.name == RUN_RECORD and "commit" in r.metadata for r in file.records):
            why = "is the beginning of a recording"
        elif pause < -_OVERLAP or (pause > _PAUSE and file not in behind):
            why = f"begins {_duration(pause)} {before.path.name} ends"
        elif differing := _differing(custom, file):
            why = f"has {differing}"
        else:
            continue
        raise UserError(
            f"two recordings in one folder: {file.path.name} {why}: give each a folder of its own, "
            "or name one of the files"
        )


def difference(bag: BagDirectory, other: BagDirectory) -> str:
    """Return how a file differs from a bag."""
    when = f"it begins {_duration(other.start - bag.start)} the bag"
    return ", ".join(filter(None, (when, _differing(bag.custom_data, other))))


def _differing(custom: Mapping[str, str], file: BagDirectory) -> str:
    return ", ".join(
        f"another {key}"
        for key in _OF_RUN
        if key in custom and file.custom_data.get(key, custom[key]) != custom[key]
    )


def _duration(time: int) -> str:
    """Return a signed time [ns] in words."""
    seconds = abs(time) / _SECOND
    number, unit = (seconds / 86400, "days") if seconds > 86400 else (seconds, "s")
    return f"{number:.1f} {unit} {'after' if time >= 0 else 'before'}"
