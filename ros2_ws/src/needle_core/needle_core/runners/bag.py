"""Run a component on a bag: recorded messages in, at the times at which they were sent.

Nobody calls its services and nothing comes in at its ports: no bag has either. Its timers tick on
the bag's clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from needle_core.component import Actions, Component, Moment, Peers, Publish, Send


class BagRunner:
    """A component on recorded messages.

    Parameters
    ----------
    component : Component
        It runs as it is.
    received : iterable of str
        Its topics that somebody receives; what it publishes on others is dropped.

    Attributes
    ----------
    counts : Counter of str
        What it has sent: messages by topic, batches by port.
    """

    def __init__(self, component: Component, received: Iterable[str]) -> None:
        self._component = component
        self._received = frozenset(received)
        self._handlers = {row.topic: row.handler for row in component.inputs}
        self._due: list[float] = []
        self._is_started = False
        self.counts: Counter[str] = Counter()

    def deliver(self, topic: str, message: Any, at: Moment) -> Iterator[Publish]:
        """Let the timers tick that are due, then handle a message; yield what is published.

        A timer that was missed ticks once, not once for each period.
        """
        if not self._is_started:
            self._is_started = True
            self._due = [at.steady + timer.period for timer in self._component.timers]
            peers = Peers(subscribers=dict.fromkeys(self._received, ("bag",)))
            yield from self._carried_out(self._component.on_peers(peers, at))
        for number, timer in enumerate(self._component.timers):
            late = at.steady - self._due[number]
            if late >= 0.0:
                self._due[number] += timer.period * (1 + late // timer.period)
                yield from self._carried_out(timer.handler(at))
        yield from self._carried_out(self._handlers[topic](message, at))

    def arrive(self, port: str, batch: tuple[Any, ...], at: Moment) -> list[Publish]:
        """Let a batch come in at a port; return what is published."""
        rows = [row for row in self._component.ports if row.name == port]
        return [action for row in rows for action in self._carried_out(row.handler(batch, at))]

    def finish(self, at: Moment) -> Iterator[Publish]:
        """Let every timer tick once more; yield what is published."""
        for timer in self._component.timers:
            yield from self._carried_out(timer.handler(at))

    def _carried_out(self, actions: Actions) -> Iterator[Publish]:
        for action in actions:
            match action:
                case Publish(topic) if topic in self._received:
                    self.counts[topic] += 1
                    yield action
                case Send(port):
                    self.counts[port] += 1
