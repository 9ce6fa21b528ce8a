"""Record of what a node has heard, in order, so that a bag tells what it decided from.

A node on a busy machine hears a message some time after it was sent, what was sent meanwhile may be
heard before it, and what its queue has no room for it never hears.
"""

from __future__ import annotations

import re
from typing import NamedTuple

_MOST = 100
"""Messages in one list: one or two seconds of a rig that stands still."""
_HEARD = re.compile(r"(\S+) (\d{1,19})")


class HeardMessage(NamedTuple):
    """A message by its topic and the time of its sending, on its sender's clock [ns]."""

    topic: str
    sent_ns: int


class HeardMessages:
    """Messages heard since they were last told."""

    def __init__(self) -> None:
        self._heard: list[HeardMessage] = []

    def add(self, topic: str, sent_ns: int) -> None:
        """Take that a message was heard, by its topic and the time of its sending [ns]."""
        self._heard.append(HeardMessage(topic, sent_ns))

    @property
    def is_full(self) -> bool:
        """Whether it is to be told before more is heard."""
        return len(self._heard) >= _MOST

    def take_text(self) -> str:
        """Return what was heard as text, each message once."""
        text = ", ".join(f"{topic} {sent_ns}" for topic, sent_ns in self._heard)
        self._heard.clear()
        return text


def heard_messages(text: str) -> list[HeardMessage]:
    """Return the messages from `HeardMessages.take_text`."""
    found = map(_HEARD.fullmatch, text.split(", "))
    return [HeardMessage(match[1], int(match[2])) for match in found if match is not None]
