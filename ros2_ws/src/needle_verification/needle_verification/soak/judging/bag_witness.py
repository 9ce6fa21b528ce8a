"""Messages as a recorder takes them, beside those in its bag: what is missing is said to be."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path

from mcap.reader import make_reader

from needle_bags.recording.recording import MESSAGES_LOST
from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.files.bag_path import METADATA_FILE
from needle_core.files.plain_yaml import load_plain

# A killed recorder's bag has what it took so long before [ns]: it writes out every 0.1 s
# (docs/architecture.md), and a burst takes its time.
_WRITTEN_OUT_NS = 300_000_000


class BagWitness:
    """Takes note of every message that one recorder takes.

    Parameters
    ----------
    bag : Path
        Its bag.
    overflows : Counter of str
        Messages of each topic that its queues had no room for before it began.
    """

    def __init__(self, bag: Path, overflows: Mapping[str, int]) -> None:
        self._bag = bag
        self._before = Counter(overflows)
        # When each was taken, by what tells two messages of a topic apart; one that comes twice,
        # as after another subscription was made, may be taken for one.
        self._taken: defaultdict[str, dict[tuple[int, int], int]] = defaultdict(dict)

    def take(self, at_ns: int, topic: str, sent_ns: int, number: int) -> None:
        """Take a message: when it was taken, when sent, and its publisher's number of it."""
        self._taken[topic].setdefault((sent_ns, number), at_ns)

    def losses_of_ended(self, overflows: Mapping[str, int]) -> list[str]:
        """Return what the bag of a recorder that ended in order lacks and does not name.

        Parameters
        ----------
        overflows : mapping of str to int
            As at its begin.
        """
        kept, told = _counts(self._bag), _said_lost(self._bag)
        wanted = Counter({topic: len(taken) for topic, taken in self._taken.items()})
        wanted += Counter(overflows) - self._before
        return [
            f"{topic}: {count} came, {kept[topic]} are in the bag, {told[topic]} said to be lost"
            for topic, count in sorted(wanted.items())
            if kept[topic] + told[topic] < count
        ]

    def losses_of_killed(self, killed_ns: int) -> list[str]:
        """Return what the recovered bag of a recorder lacks that it had long enough."""
        recover_bag(self._bag)
        kept = _counts(self._bag)
        until_ns = killed_ns - _WRITTEN_OUT_NS
        wanted = {
            topic: sum(at_ns <= until_ns for at_ns in taken.values())
            for topic, taken in self._taken.items()
        }
        return [
            f"{topic}: {count} came in time, {kept[topic]} are in the recovered bag"
            for topic, count in sorted(wanted.items())
            if kept[topic] < count
        ]


def _counts(bag: Path) -> Counter[str]:
    """Return the number of messages of each topic, by the data files themselves."""
    counts: Counter[str] = Counter()
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            for _, channel, _ in make_reader(stream).iter_messages():
                counts[channel.topic] += 1
    return counts


def _said_lost(bag: Path) -> Counter[str]:
    """Return what metadata.yaml says of messages that are not in the bag."""
    content = load_plain((bag / METADATA_FILE).read_text(encoding="utf-8"))
    custom = content["rosbag2_bagfile_information"]["custom_data"] or {}
    return Counter(json.loads(custom.get(MESSAGES_LOST, "{}")))
