"""Losses of a damaged bag, to the message, by topic, as far as anything tells."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any, Final

from needle_bags.recovery.mcap_records import McapScan

_NUMBER: Final = re.compile(r"^(.*_)(\d+)(\.mcap)$")


@dataclasses.dataclass(frozen=True)
class Losses:
    """Losses: messages that were recorded and cannot be read.

    Attributes
    ----------
    messages : dict of str to int
        By topic.
    is_exact : bool
        Whether these are all: told by what was counted when the recording ended.
    untold : list of str
        Topics of which more may be lost: their messages have no numbers, or those of several
        publishers.
    bytes : dict of str to int
        What could not be read, by file.
    missing : list of str
        Files that are not there, or hold nothing of a bag.
    """

    messages: dict[str, int]
    is_exact: bool
    untold: list[str]
    bytes: dict[str, int]
    missing: list[str]

    def lines(self) -> list[str]:
        """Return what was lost, one sentence a line."""
        found = []
        if self.messages:
            each = ", ".join(f"{name} {count}" for name, count in sorted(self.messages.items()))
            more = "" if self.is_exact else "at least "
            found.append(f"{more}{sum(self.messages.values())} messages: {each}")
        found += [f"{name}: {count} bytes could not be read" for name, count in self.bytes.items()]
        found += [f"{name} is missing" for name in self.missing]
        if not self.is_exact and (self.bytes or self.missing):
            found.append(
                "how many messages were in the end that was cut off, or in a file that is missing, "
                "cannot be told"
            )
            if self.untold:
                found.append(
                    f"nor how many between others of {', '.join(self.untold)}: their messages are "
                    "not numbered one by one"
                )
        return found

    def text(self) -> str:
        """Return it in one line."""
        return (
            "; ".join(self.lines())
            or "the recording was not completed; all that was written is here"
        )


def find_losses(
    old: Mapping[str, Any], files: Mapping[str, McapScan], foreign: Sequence[str]
) -> Losses:
    """Return what was lost.

    Parameters
    ----------
    old : mapping
        What metadata.yaml said; empty where it could not be read.
    files : mapping
        What is in the files that are there, by name.
    foreign : sequence of str
        Files of the bag that hold nothing of one.
    """
    there: Counter[str] = Counter()
    for found in files.values():
        there.update(found.topic_counts)
    missing = [*foreign, *_missing(old, files)]
    told = _told(old, files, missing)
    lost = Counter(told) - there if told is not None else _by_gaps(files)
    untold: set[str] = set()
    if told is None:
        for found in files.values():
            if found.damage:
                untold.update(found.channels[n].topic for n in found.gaps.untold)
    size = {name: found.bytes_lost for name, found in files.items() if found.bytes_lost}
    return Losses(dict(+lost), told is not None, sorted(untold), size, missing)


def _told(
    old: Mapping[str, Any], files: Mapping[str, McapScan], missing: Sequence[str]
) -> Counter[str] | None:
    """Return how many messages were recorded, by topic; None if nothing reliable tells."""
    indexes = [found.index for found in files.values()]
    checked = [index for index in indexes if index is not None and index.is_checked]
    if not missing and len(checked) == len(indexes):
        return sum((Counter(index.counts()) for index in checked), Counter[str]())
    try:
        told = Counter(
            {
                str(entry["topic_metadata"]["name"]): int(entry["message_count"])
                for entry in old["topics_with_message_count"]
            }
        )
        of_files = {str(f["path"]): int(f["message_count"]) for f in old.get("files") or []}
        is_sound = told.total() == old["message_count"] and (
            not of_files or sum(of_files.values()) == told.total()
        )
    except (KeyError, TypeError, ValueError):
        return None
    return told if is_sound else None


def _by_gaps(files: Mapping[str, McapScan]) -> Counter[str]:
    lost: Counter[str] = Counter()
    for found in files.values():
        for number, count in found.gaps.missing.items():
            if number not in found.gaps.untold:
                lost[found.channels[number].topic] += count
    return lost


def _missing(old: Mapping[str, Any], files: Mapping[str, McapScan]) -> list[str]:
    told = old.get("relative_file_paths")
    paths = [PurePath(str(name)) for name in told] if isinstance(told, list) else []
    # Those that were compressed as a whole are unpacked by now.
    names = [path.name.removesuffix(".zstd") for path in paths]
    numbered = [match for name in files if (match := _NUMBER.match(name))]
    if numbered:
        stem, _, ending = numbered[0].groups()
        last = max(int(match[2]) for match in numbered)
        if last < 10 * len(numbered) + 10:
            names += [f"{stem}{number}{ending}" for number in range(last)]
    return sorted({name for name in names if name not in files})
