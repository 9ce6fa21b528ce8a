"""When the controller heard the tips, as far as a bag tells.

A node on a busy machine hears a message some time after it was sent, and what was sent meanwhile
may be heard before it. For tips that decides which one a step is made from. The bag tells by what
the controller did: it heard a tip that it used just before it published the estimate.
"""

from __future__ import annotations

import numpy as np

from needle_bringup.bag_copy import stamp_of
from needle_bringup.bag_order import SentMessage
from needle_bringup.bag_reader import Run
from needle_bringup.innovation import refused_tips


def unheard_tips(run: Run) -> frozenset[int]:
    """Return the stamps of tips that the controller neither used nor refused [ns].

    They came while it wanted none. When that was, a bag tells only so far as it shows here.
    """
    told = np.concatenate([run.estimate.stamps, refused_tips(run)])
    return frozenset(np.setdiff1d(run.tips.stamps, told).tolist())


def as_heard(messages: list[SentMessage], namespace: str) -> list[SentMessage]:
    """Return the messages with the times at which the controller heard the tips among them.

    Parameters
    ----------
    messages : list of SentMessage
        Everything small in a bag.
    namespace : str
        Of the rig's topics, `/` or with one at its end.
    """
    used = {stamp_of(m.data): m.time for m in messages if m.topic == f"{namespace}needle/estimate"}
    heard: list[SentMessage] = []
    latest = 0
    for message in sorted(messages, key=lambda m: m.time):
        time = message.time
        if message.topic == f"{namespace}needle/tip":
            # A topic keeps its order: no tip is heard before the one before it.
            time = latest = max(time, latest, used.get(stamp_of(message.data), 0) - 1)
        heard.append(message._replace(time=time))
    return heard
