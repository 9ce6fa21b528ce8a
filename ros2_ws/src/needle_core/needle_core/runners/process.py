"""Component as a simulated process whose handlers run in sequence and take compute time."""

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
    """Runs the handlers of a component; an exception in one becomes a diagnostic.

    Parameters
    ----------
    outputs : iterable of Output
        Outputs of the component.
    """

    def __init__(self, outputs: Iterable[Output]) -> None:
        self._topics = {output.topic for output in outputs}
        self._failures = 0

    def run(self, work: Callable[[], Actions]) -> list[Action]:
        """Return the actions of a handler; if it fails, those before the failure and its report."""
        actions: list[Action] = []
        try:
            for action in work():
                if isinstance(action, Publish) and action.topic not in self._topics:
                    raise ValueError(f"{action.topic} is not among its outputs")
                actions.append(action)
        except Exception as error:  # noqa: BLE001 - a message may cause any error
            self._failures += 1
            text = f"internal error: {type(error).__name__}: {error}"
            failed = Diagnostic(Level.ERROR, text, {"failures": str(self._failures)})
            actions += [Log("error", text, kind=text), Diagnose("handlers", failed)]
        return actions


Compute = Callable[[Sequence[Action], random.Random], float]
"""Compute time of a handler [s], from its actions and a random stream."""
Work = Callable[[Moment], Actions]


def uniform(shortest: float, longest: float) -> Compute:
    """Return a function that draws compute times [s] uniformly between two bounds."""
    return lambda actions, rng: rng.uniform(shortest, longest)


class Process:
    """Component with its event queue.

    Parameters
    ----------
    component : Component
        Component to run.
    compute : Compute
        Compute times of its handlers.
    timeline : Timeline
        Virtual time.
    execute : callable
        Executes each action of a finished handler.

    Attributes
    ----------
    is_alive : bool
        Whether the process is running; a process that has ended handles no events.
    slowness : float
        Additional compute time of each handler [s].
    known : list of Process
        Processes that this one has discovered.
    routes : dict of str to list
        Topic to its discovered receivers, each with row and link; built on demand.
    batches : dict of str to list
        Port to its queued items.
    latched : dict of str to object
        Topic to its last message, for late subscribers.
    health : dict of str to Diagnostic
        Part to its last diagnostic.
    """

    def __init__(
        self,
        component: Component,
        compute: Compute,
        timeline: Timeline,
        execute: Callable[[Process, Action], None],
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
        self._compute, self._timeline, self._execute = compute, timeline, execute
        self._is_busy = False
        self._free_at = self._frozen_until = 0.0
        self._queue: deque[tuple[str, Work, int]] = deque()
        self._waiting: Counter[str] = Counter()
        self._handlers = Handlers(component.outputs)

    @property
    def is_frozen(self) -> bool:
        """Whether the process is frozen."""
        return self._timeline.now < self._frozen_until

    def enqueue(
        self, source: str, work: Work, *, depth: int | None = None, sent_ns: int = 0
    ) -> None:
        """Queue an event; of each source, only the newest `depth` events are kept."""
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
        self._handle_queue()

    def freeze(self, seconds: float) -> None:
        """Freeze for some time, like a process after SIGSTOP."""
        self._frozen_until = max(self._frozen_until, self._timeline.now + seconds)

    def end(self) -> None:
        """End the process and drop its queue."""
        self.is_alive = False
        self._queue.clear()

    def _handle_queue(self) -> None:
        """Handle waiting events as soon as the previous handler has finished."""
        while self._queue and not self._is_busy:
            if self._due > self._timeline.now:
                self._is_busy = True
                self._timeline.call_at(self._due, self._become_free)
            else:
                source, work, sent_ns = self._queue.popleft()
                self._waiting[source] -= 1
                self._handle_now(source, work, sent_ns)

    def _become_free(self) -> None:
        self._is_busy = False
        self._handle_queue()

    @property
    def _due(self) -> float:
        """Time at which the next event can be handled [s]."""
        return max(self._free_at, self._frozen_until)

    def _handle_now(self, source: str, work: Work, sent_ns: int) -> None:
        at = self._timeline.moment(sent_ns)
        actions = self._handlers.run(lambda: work(at))
        stream = self._timeline.stream(f"{self.name}/{source}")
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
                self._execute(self, action)
        self._become_free()
