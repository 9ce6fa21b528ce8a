"""Faults of messages, calls and frames on their way."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

from needle_core.can_frame import CAN
from needle_core.runners.transport import Arrival, Arrivals, Link
from scenario.faults import BUS, PAGE_LINE, TOPICS

# From sending what was lost to sending it again [s]: a reliable topic, and TCP.
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
        When it ends [s].
    loss : float
        Share of messages that do not arrive.
    late : float
        How much later they arrive at most [s].
    duplicates : float
        Share that arrives twice.
    reorders : bool
        Whether later ones may overtake earlier ones.
    """

    until: float
    loss: float = 0.0
    late: float = 0.0
    duplicates: float = 0.0
    reorders: bool = False


class LinkFaults:
    """The faults that are on, by the part that they are on; a fault of the virtual runner.

    What is sent again when it is lost (reliable topics, TCP) comes late instead, and in order. On
    the bus each frame of a batch meets its own.
    """

    def __init__(self) -> None:
        self._on: dict[str, LinkFault] = {}

    def begin(self, part: str, fault: LinkFault) -> None:
        """Let a fault begin; it takes the place of another on the same link."""
        self._on[part] = fault

    def end(self, part: str) -> None:
        """Let the fault on a link end."""
        self._on.pop(part, None)

    def __call__(self, link: Link, message: Any, now: float, rng: random.Random) -> Arrivals | None:
        """Return what arrives of a message that is sent now; None: nothing befalls it."""
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
