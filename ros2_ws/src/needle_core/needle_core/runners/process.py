"""A component as a process: its handlers run one after the other, each for its compute time."""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from needle_core.component import (
    Action,
    Actions,
    Component,
    Diagnose,
    Input,
    Log,
    Moment,
    Output,
    Publish,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.runners.timeline import Timeline
from needle_core.runners.transport import Link


class Handlers:
    """Runs the handlers of a component.

    Parameters
    ----------
    outputs : iterable of Output
        The component's.
    """

    def __init__(self, outputs: Iterable[Output]) -> None:
        self._topics = {output.topic for output in outputs}
        self._failures = 0

    def run(self, work: Callable[[], Actions]) -> list[Action]:
        """Return the actions of a handler; what it did before it failed is done."""
        actions: list[Action] = []
        try:
            for action in work():
                if isinstance(action, Publish) and action.topic not in self._topics:
                    raise ValueError(f"{action.topic} is not among its outputs")
                actions.append(action)
        except Exception as error:  # noqa: BLE001 - whatever a message may lead to
            self._failures += 1
            text = f"internal error: {type(error).__name__}: {error}"
            failed = Diagnostic(Level.ERROR, text, {"failures": str(self._failures)})
            actions += [Log("error", text, kind=text), Diagnose("handlers", failed)]
        return actions


Compute = Callable[[Sequence[Action], random.Random], float]
"""Compute time of a handler [s], from its actions and a random stream."""
Work = Callable[[Moment], Actions]


def uniform(shortest: float, longest: float) -> Compute:
    """Return a compute time that is the same for all handlers, between two bounds [s]."""
    return lambda actions, rng: rng.uniform(shortest, longest)


class Process:
    """A component with its queue.

    Parameters
    ----------
    component : Component
        What runs.
    compute : Compute
        Compute times of its handlers.
    timeline : Timeline
        Its time.
    carry_out : callable
        Carries out each action of a handler that has ended.

    Attributes
    ----------
    is_alive : bool
        Whether it runs; what has ended never does anything again.
    slowness : float
        What each handler takes longer than usual [s].
    known : list of Process
        Those that it knows.
    routes : dict of str to list
        Topic to those of them that receive it, each with its row and the link; made when needed.
    batches : dict of str to list
        Port to what waits there.
    latched : dict of str to object
        Topic to its last message, for those that come late.
    health : dict of str to Diagnostic
        Part to what it last said of it.
    """

    def __init__(
        self,
        component: Component,
        compute: Compute,
        timeline: Timeline,
        carry_out: Callable[[Process, Action], None],
    ) -> None:
        self.component = component
        self.name = component.name
        self.outputs = {output.topic: output for output in component.outputs}
        self.is_alive = True
        self.slowness = 0.0
        self.known: list[Process] = []
        self.routes: dict[str, list[tuple[Process, Input, Link]]] = {}
        self.batches: dict[str, list[Any]] = {}
        self.latched: dict[str, Any] = {}
        self.health: dict[str, Diagnostic] = {}
        self._compute, self._timeline, self._carry_out = compute, timeline, carry_out
        self._is_busy = False
        self._free_at = self._frozen_until = 0.0
        self._queue: deque[tuple[str, Work, int]] = deque()
        self._waiting: Counter[str] = Counter()
        self._streams: dict[str, random.Random] = {}
        self._handlers = Handlers(component.outputs)

    @property
    def is_frozen(self) -> bool:
        """Tell whether it is frozen."""
        return self._timeline.now < self._frozen_until

    def offer(self, source: str, work: Work, *, depth: int | None = None, sent_ns: int = 0) -> None:
        """Queue an event; of one source only the newest `depth` wait."""
        if not self.is_alive:
            return
        now = self._timeline.now
        if not self._is_busy and self._free_at <= now >= self._frozen_until and not self._queue:
            self._handle_now(source, work, sent_ns)
            return
        if depth is not None and self._waiting[source] >= depth:
            oldest = next(n for n, item in enumerate(self._queue) if item[0] == source)
            del self._queue[oldest]
            self._waiting[source] -= 1
        self._waiting[source] += 1
        self._queue.append((source, work, sent_ns))
        self._go_on()

    def freeze(self, seconds: float) -> None:
        """Stand still from now on, as a stopped process does."""
        self._frozen_until = max(self._frozen_until, self._timeline.now + seconds)

    def end(self) -> None:
        """Do nothing any more."""
        self.is_alive = False
        self._queue.clear()

    def _go_on(self) -> None:
        """Handle what waits as soon as the handler before has taken its time."""
        while self._queue and not self._is_busy:
            if self._due > self._timeline.now:
                self._is_busy = True
                self._timeline.call_at(self._due, self._get_free)
            else:
                source, work, sent_ns = self._queue.popleft()
                self._waiting[source] -= 1
                self._handle_now(source, work, sent_ns)

    def _get_free(self) -> None:
        self._is_busy = False
        self._go_on()

    @property
    def _due(self) -> float:
        """Time at which the next event may be handled [s]."""
        return max(self._free_at, self._frozen_until)

    def _handle_now(self, source: str, work: Work, sent_ns: int) -> None:
        at = self._timeline.moment(sent_ns)
        actions = self._handlers.run(lambda: work(at))
        stream = self._streams.get(source)
        if stream is None:
            stream = self._streams[source] = self._timeline.stream(f"{self.name}/{source}")
        seconds = self._compute(actions, stream) + self.slowness
        self._free_at = self._timeline.now + seconds
        if actions:
            self._is_busy = True
            self._timeline.call_at(self._free_at, partial(self._finish, actions))

    def _finish(self, actions: Sequence[Action]) -> None:
        if self.is_frozen:
            self._timeline.call_at(self._frozen_until, partial(self._finish, actions))
            return
        for action in actions:
            if self.is_alive:
                self._carry_out(self, action)
        self._get_free()
