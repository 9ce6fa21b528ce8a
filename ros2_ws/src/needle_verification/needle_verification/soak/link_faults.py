"""Faults of messages on their way."""

from __future__ import annotations

import dataclasses

from needle_verification.soak.virtual_world import VirtualWorld


@dataclasses.dataclass(frozen=True)
class Delivery:
    """One arrival of a message.

    Attributes
    ----------
    data : bytes
        What arrives.
    late_ns : int
        How much later than usual [ns].
    overtakes : bool
        Whether it may arrive before what was sent earlier.
    """

    data: bytes
    late_ns: int = 0
    overtakes: bool = False


@dataclasses.dataclass
class LinkFault:
    """Fault of one topic, service or bus while it lasts.

    Attributes
    ----------
    loss : float
        Share of messages that do not arrive.
    late_ns : int
        How much later they arrive at most [ns].
    duplicates : float
        Share that arrives twice.
    reorders : bool
        Whether later ones may overtake earlier ones.
    """

    loss: float = 0.0
    late_ns: int = 0
    duplicates: float = 0.0
    reorders: bool = False


class Way:
    """Chance on one link: what a fault draws shifts nothing of how long messages take.

    Parameters
    ----------
    world : VirtualWorld
        Its chance.
    span_ns : tuple of int
        What a message takes at least and at most [ns].
    names : str
        From whom, what, to whom.

    Attributes
    ----------
    faults : Random
        Draws for what goes wrong.
    """

    def __init__(self, world: VirtualWorld, span_ns: tuple[int, int], *names: str) -> None:
        self.faults = world.chance("faults on the way", *names)
        self._span_ns = span_ns
        self._chance = world.chance("way", *names)

    def takes_ns(self) -> int:
        """Return how long the next message takes [ns]."""
        return self._chance.randint(*self._span_ns)


class LinkFaults:
    """The faults that are on, by the name of what they are on."""

    def __init__(self) -> None:
        self._on: dict[str, LinkFault] = {}

    def begin(self, name: str, fault: LinkFault) -> None:
        """Let a fault begin; it takes the place of another on the same link."""
        self._on[name] = fault

    def end(self, name: str) -> None:
        """Let the fault on a link end."""
        self._on.pop(name, None)

    def deliveries(self, name: str, data: bytes, way: Way) -> list[Delivery]:
        """Return all arrivals of a message that is sent now."""
        fault = self._on.get(name)
        if fault is None:
            return [Delivery(data)]
        draw = way.faults.random
        deliveries = []
        for _ in range(2 if draw() < fault.duplicates else 1):
            if draw() < fault.loss:
                continue
            late_ns = way.faults.randint(0, fault.late_ns)
            deliveries.append(Delivery(data, late_ns, fault.reorders))
        return deliveries
