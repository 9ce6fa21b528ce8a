"""Faults of messages, calls and frames in transit."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

from needle_core.can_frame import CAN
from needle_core.runners.transport import Arrival, Arrivals, Link
from scenario.faults import BUS, PAGE_LINE, TOPICS

# Delay of a retransmission [s]: reliable topic, TCP.
_RESEND, _RESEND_TCP = (0.02, 0.1), (0.2, 0.4)
_BEST_EFFORT = ("/joy", "/device/hold")
_PARTS = {CAN: BUS, PAGE_LINE: PAGE_LINE}
_RESENT = {
    **{topic: _RESEND for topic in TOPICS if topic not in _BEST_EFFORT},
    PAGE_LINE: _RESEND_TCP,
}


@dataclasses.dataclass(frozen=True)
class LinkFault:
    """Fault of one topic, service or bus while it lasts.

    Attributes
    ----------
    until : float
        End [s].
    loss : float
        Share of lost messages.
    late : float
        Largest added delay [s].
    duplicates : float
        Share of duplicated messages.
    reorders : bool
        Whether messages may be reordered.
    """

    until: float
    loss: float = 0.0
    late: float = 0.0
    duplicates: float = 0.0
    reorders: bool = False


class LinkFaults:
    """Active faults by link; called by the virtual runner for each message.

    Reliable topics and TCP retransmit lost messages, which arrive late and in order. On the bus,
    faults apply to each frame of a batch.
    """

    def __init__(self) -> None:
        self._on: dict[str, LinkFault] = {}

    def begin(self, part: str, fault: LinkFault) -> None:
        """Begin a fault, which replaces another one on the same link."""
        self._on[part] = fault

    def end(self, part: str) -> None:
        """End the fault on a link."""
        self._on.pop(part, None)

    def __call__(self, link: Link, message: Any, now: float, rng: random.Random) -> Arrivals | None:
        """Return the arrivals of a message that is sent now; None without a fault."""
        if not self._on:
            return None
        part = _PARTS.get(link.topic, f"/{link.topic}")
        fault = self._on.get(part)
        if fault is None:
            return None
        resend = _RESENT.get(part)
        whole = [(frame,) for frame in message] if part == BUS else [message]
        return [arrival for one in whole for arrival in _arrivals(fault, one, now, rng, resend)]


def _arrivals(
    fault: LinkFault,
    message: Any,
    now: float,
    rng: random.Random,
    resend: tuple[float, float] | None,
) -> Arrivals:
    arrivals = []
    for _ in range(2 if rng.random() < fault.duplicates else 1):
        late = rng.uniform(0.0, fault.late)
        while resend and now + late < fault.until and rng.random() < fault.loss:
            late += rng.uniform(*resend)
        if resend or rng.random() >= fault.loss:
            arrivals.append(Arrival(late, message, fault.reorders and resend is None))
    return arrivals
