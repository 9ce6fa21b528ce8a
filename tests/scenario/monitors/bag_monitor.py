"""Messages as a recorder takes them, beside those in its bag: what is missing is said to be."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from pathlib import Path

from mcap.reader import make_reader

from needle_bags.recording.recording import MESSAGES_LOST
from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError
from needle_core.files.bag_path import METADATA_FILE
from needle_core.files.yaml_files import load_yaml

WAITING_LIMIT = 400_000
"""What waits for the soak's disk at most [B]; a real recorder may keep far more."""
# A killed recorder's bag has what it took so long before [s]: it writes out every 0.1 s
# (docs/architecture.md), and a burst takes its time.
_WRITTEN_OUT = 0.3


class BagMonitor:
    """Takes note of every message that one recorder takes.

    Parameters
    ----------
    bag : Path
        Its bag.
    """

    def __init__(self, bag: Path) -> None:
        self._bag = bag
        # Topic to the times at which its messages were taken [s].
        self._taken: defaultdict[str, list[float]] = defaultdict(list)

    def take(self, at: float, topic: str) -> None:
        """Take a message at a time [s]."""
        self._taken[topic].append(at)

    def losses_of_ended(self) -> list[str]:
        """Return what the bag of a recorder that ended in order lacks and does not name."""
        kept, told = _counts(self._bag), _said_lost(self._bag)
        return [
            f"{topic}: {len(taken)} came, {kept[topic]} are in the bag, {told[topic]} said to be "
            "lost"
            for topic, taken in sorted(self._taken.items())
            if kept[topic] + told[topic] < len(taken)
        ]

    def losses_of_killed(self, killed_at: float) -> list[str]:
        """Return what the recovered bag of a recorder lacks that it had long enough."""
        try:
            recover_bag(self._bag)
        except UserError:
            # Nothing of it can be recovered.
            kept = Counter[str]()
        else:
            kept = _counts(self._bag)
        wanted = {
            topic: sum(at <= killed_at - _WRITTEN_OUT for at in taken)
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
    content = load_yaml((bag / METADATA_FILE).read_text(encoding="utf-8"))
    custom = content["rosbag2_bagfile_information"]["custom_data"] or {}
    return Counter(json.loads(custom.get(MESSAGES_LOST, "{}")))
