"""Messages that a recorder received, compared with those in its bag."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from pathlib import Path

from mcap.reader import make_reader

from needle_bags.reading.bag_messages import read_contents
from needle_bags.recording.recording import MESSAGES_LOST
from needle_bags.recovery.bag_recovery import recover_bag
from needle_core.errors import UserError

WAITING_LIMIT = 400_000
"""Queue limit of the soak's recorder [B]; the default of the node is far larger."""
# The bag of a killed recorder has all messages older than this [s]: it flushes every 0.1 s
# (docs/architecture.md), and a burst takes longer.
_WRITTEN_OUT = 0.3


class BagMonitor:
    """Keeps the time and topic of every message that one recorder receives.

    Parameters
    ----------
    bag : Path
        Its bag.
    """

    def __init__(self, bag: Path) -> None:
        self._bag = bag
        # Reception times by topic [s].
        self._taken: defaultdict[str, list[float]] = defaultdict(list)

    def record(self, at: float, topic: str) -> None:
        """Record the reception of a message at a time [s]."""
        self._taken[topic].append(at)

    def losses_after_clean_end(self) -> list[str]:
        """Return the losses of a cleanly ended recorder that its bag does not report."""
        kept = _counts(self._bag)
        lost = Counter(json.loads(read_contents(self._bag).custom_data.get(MESSAGES_LOST, "{}")))
        return [
            f"{topic}: {len(taken)} came, {kept[topic]} are in the bag, {lost[topic]} reported lost"
            for topic, taken in sorted(self._taken.items())
            if kept[topic] + lost[topic] < len(taken)
        ]

    def losses_after_kill(self, killed_at: float) -> list[str]:
        """Return the losses of a killed recorder among messages that it must have flushed."""
        try:
            recover_bag(self._bag)
        except UserError:
            # Nothing can be recovered.
            kept = Counter[str]()
        else:
            kept = _counts(self._bag)
        required = {
            topic: sum(at <= killed_at - _WRITTEN_OUT for at in taken)
            for topic, taken in self._taken.items()
        }
        return [
            f"{topic}: {count} came in time, {kept[topic]} are in the recovered bag"
            for topic, count in sorted(required.items())
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
