"""Runner of a component on a bag: delivers the recorded messages at their send times.

Services are not called and ports stay silent, because bags contain neither. Timers follow the bag's
clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from needle_core.component import Actions, Component, Moment, Peers, Publish, Send


class BagRunner:
    """Runs a component on recorded messages.

    Parameters
    ----------
    component : Component
        Component to run.
    received : iterable of str
        Topics whose publications are returned; others are dropped.

    Attributes
    ----------
    counts : Counter of str
        Number of messages sent by topic, and of batches by port.
    """

    def __init__(self, component: Component, received: Iterable[str]) -> None:
        self._component = component
        self._received = frozenset(received)
        self._handlers = {row.topic: row.handler for row in component.inputs}
        self._due: list[float] = []
        self._is_started = False
        self.counts: Counter[str] = Counter()

    def deliver(self, topic: str, message: Any, at: Moment) -> Iterator[Publish]:
        """Run the due timers, then handle a message; yield the publications.

        A timer that missed several periods fires once.
        """
        if not self._is_started:
            self._is_started = True
            self._due = [at.steady + timer.period for timer in self._component.timers]
            peers = Peers(subscribers=dict.fromkeys(self._received, ("bag",)))
            yield from self._publications(self._component.on_peers(peers, at))
        for number, timer in enumerate(self._component.timers):
            late = at.steady - self._due[number]
            if late >= 0.0:
                self._due[number] += timer.period * (1 + late // timer.period)
                yield from self._publications(timer.handler(at))
        yield from self._publications(self._handlers[topic](message, at))

    def arrive(self, port: str, batch: tuple[Any, ...], at: Moment) -> list[Publish]:
        """Handle a batch that arrives at a port; return the publications."""
        rows = [row for row in self._component.ports if row.name == port]
        return [action for row in rows for action in self._publications(row.handler(batch, at))]

    def finish(self, at: Moment) -> Iterator[Publish]:
        """Run every timer once more; yield the publications."""
        for timer in self._component.timers:
            yield from self._publications(timer.handler(at))

    def _publications(self, actions: Actions) -> Iterator[Publish]:
        for action in actions:
            match action:
                case Publish(topic) if topic in self._received:
                    self.counts[topic] += 1
                    yield action
                case Send(port):
                    self.counts[port] += 1
