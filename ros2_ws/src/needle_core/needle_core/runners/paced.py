"""Virtual runner at the pace of the wall clock, with input from web pages and other processes."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from needle_core.component import Batch, Component, PortChange, RealPort
from needle_core.runners.process import Process
from needle_core.runners.virtual import VirtualRunner

SLACK = 0.05
"""Longest delay behind the wall clock that the runner makes up for; longer ones are lost [s]."""


class PacedRunner(VirtualRunner):
    """Runs components no faster than the wall clock, and delivers input of real ports.

    External input is handled at the virtual time that corresponds to the wall clock, or at once if
    the computer has fallen behind. Lost time is not made up: the needle must not run ahead of the
    operator's hand.

    Parameters
    ----------
    components : iterable of Component
        Components, each run as its own process.
    seed : int
        Seed of latencies and compute times.
    pace : float
        Ratio of virtual to real time.
    ports : mapping of str to RealPort
        Real ports, by the name of the component's port.
    bell : threading.Event, optional
        Signals new input.
    clock : callable, optional
        Returns the monotonic real time [s].
    more : dict
        Further arguments of `VirtualRunner`.

    Attributes
    ----------
    lag : float
        Lost time with respect to the wall clock [s].
    """

    def __init__(
        self,
        components: Iterable[Component],
        seed: int = 0,
        *,
        pace: float = 1.0,
        ports: Mapping[str, RealPort] | None = None,
        bell: threading.Event | None = None,
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
            port.open(partial(self._on_input, name))

    def close(self) -> None:
        """Close the ports."""
        for port in self._ports.values():
            port.close()

    def run(self, seconds: float) -> bool:
        """Run until a component exits, or for `seconds`; return whether one exited."""
        # Schedule the end as an event, so that the runner waits for it.
        self.timeline.call_after(seconds, lambda: None)
        return self.timeline.run(seconds, self._wait_for)

    def _wait_for(self, due: float) -> bool:
        behind = self._wall_time() - due
        if behind > SLACK * self._pace:
            self.lag += behind / self._pace
            self._anchor = (due, self._clock())
        if not (self._bell.is_set() or self._bell.wait(max(-behind / self._pace, 0.0))):
            return True
        self._bell.clear()
        self.timeline.now = max(self.now, min(self._wall_time(), due))
        while self._arrived:
            self._deliver_input(*self._arrived.popleft())
        return False

    def _on_input(self, port: str, batch: Batch | PortChange) -> None:
        """Queue input of a port, from any thread."""
        self._arrived.append((port, batch))
        self._bell.set()

    def _deliver_input(self, port: str, batch: Batch | PortChange) -> None:
        items = batch() if callable(batch) else batch
        for process in self._processes.values():
            for row in process.component.ports:
                if row.name == port and isinstance(items, PortChange):
                    process.enqueue(port, partial(row.on_change, items))
                elif row.name == port and not isinstance(items, PortChange) and items:
                    self._arrive(process, row, items)

    def _wall_time(self) -> float:
        """Return the virtual time that corresponds to the wall clock [s]."""
        wall = self._clock()
        if self._anchor is None:
            self._anchor = (self.now, wall)
        return self._anchor[0] + (wall - self._anchor[1]) * self._pace

    def _send_through(self, sender: Process, port: str, batch: tuple[Any, ...]) -> None:
        if port in self._ports:
            self._ports[port].send(batch)
        else:
            super()._send_through(sender, port, batch)
