"""The virtual runner at the pace of the wall clock, with events from outside: pages, processes."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Protocol

from needle_core.component import Batch, Component, PortChange, RealPort
from needle_core.runners.process import Process
from needle_core.runners.virtual import VirtualRunner

SLACK = 0.05
"""So far behind the clock the runner catches up; what is more is lost [s]."""


class Bell(Protocol):
    """Part of a `threading.Event` that is used here; tests have one on a clock of their own."""

    def set(self) -> None:
        """Ring, from any thread."""

    def clear(self) -> None:
        """Take note."""

    def is_set(self) -> bool:
        """Return whether it has rung."""

    def wait(self, timeout: float) -> bool:
        """Wait until it rings, for `timeout` seconds at most; return whether it has."""


class PacedRunner(VirtualRunner):
    """Runs components no faster than the wall clock, and hands over what comes from outside.

    An outside event is handled at the virtual moment that the wall clock shows, or at once where
    the computer has fallen behind. Virtual time that is lost is not made up for: a needle under a
    person's hand must not run ahead.

    Parameters
    ----------
    components : iterable of Component
        Each is a process of its own.
    seed : int
        Keys latencies and compute times.
    pace : float
        Virtual over real time.
    ports : mapping of str to RealPort
        What is outside, by the name of the component's port.
    bell : Bell, optional
        Rung when something has come in.
    clock : callable, optional
        Returns the wall clock's steady time [s].
    more : dict
        Passed on to `VirtualRunner`.

    Attributes
    ----------
    lag : float
        Time by which the run is behind the wall clock for good [s].
    """

    def __init__(
        self,
        components: Iterable[Component],
        seed: int = 0,
        *,
        pace: float = 1.0,
        ports: Mapping[str, RealPort] | None = None,
        bell: Bell | None = None,
        clock: Callable[[], float] = time.monotonic,
        **more: Any,
    ) -> None:
        super().__init__(components, seed, **more)
        self.lag = 0.0
        self._pace, self._clock = pace, clock
        self._bell = bell or threading.Event()
        self._anchor: tuple[float, float] | None = None
        self._arrived: deque[tuple[str, Batch | PortChange]] = deque()
        self._ports = dict(ports or {})
        for name, port in self._ports.items():
            port.open(partial(self._come_in, name))

    def close(self) -> None:
        """Close the ports."""
        for port in self._ports.values():
            port.close()

    def run(self, seconds: float) -> bool:
        """Run until another component exits, or for `seconds`; return whether one did."""
        # The end is an event, too: it is waited for.
        self.timeline.call_after(seconds, lambda: None)
        return self.timeline.run(seconds, self._reach)

    def _reach(self, due: float) -> bool:
        behind = self._shown() - due
        if behind > SLACK * self._pace:
            self.lag += behind / self._pace
            self._anchor = (due, self._clock())
        if not (self._bell.is_set() or self._bell.wait(max(-behind / self._pace, 0.0))):
            return True
        self._bell.clear()
        self.timeline.now = max(self.now, min(self._shown(), due))
        while self._arrived:
            self._take(*self._arrived.popleft())
        return False

    def _come_in(self, port: str, batch: Batch | PortChange) -> None:
        """Take what has come in at a port, from any thread."""
        self._arrived.append((port, batch))
        self._bell.set()

    def _take(self, port: str, batch: Batch | PortChange) -> None:
        items = batch() if callable(batch) else batch
        for process in self._processes.values():
            for row in process.component.ports:
                if row.name == port and isinstance(items, PortChange):
                    process.offer(port, partial(row.on_change, items))
                elif row.name == port and not isinstance(items, PortChange) and items:
                    self._arrive(process, row, items)

    def _shown(self) -> float:
        """Return the virtual time that the wall clock shows [s]."""
        wall = self._clock()
        if self._anchor is None:
            self._anchor = (self.now, wall)
        return self._anchor[0] + (wall - self._anchor[1]) * self._pace

    def _send_through(self, sender: Process, port: str, batch: tuple[Any, ...]) -> None:
        if port in self._ports:
            self._ports[port].send(batch)
        else:
            super()._send_through(sender, port, batch)
