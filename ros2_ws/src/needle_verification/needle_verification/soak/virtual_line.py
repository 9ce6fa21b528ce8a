"""The connections of a page: nothing is lost on them and nothing overtakes, but all may be late."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Protocol

from needle_verification.soak.faults import PAGE_LINE
from needle_verification.soak.link_faults import LinkFaults, Way
from needle_verification.soak.virtual_world import VirtualWorld

# What a message takes on its way [ns], at least and at most.
_WAY_NS = (50_000, 1_500_000)
# From a packet that was lost to its being sent again [ns], at least and at most.
_RESEND_NS = (200_000_000, 400_000_000)


class LineEnd(Protocol):
    """One end of a connection."""

    def hear(self, text: str) -> None:
        """Take a message."""

    def see_end(self) -> None:
        """Take that there is no connection any more."""


class Connection:
    """One connection between a page and who serves it.

    Parameters
    ----------
    world : VirtualWorld
        Its time and chance.
    faults : LinkFaults
        What happens on the line.
    page : LineEnd
        Who connects.

    Attributes
    ----------
    to_server, to_page : Direction
        Both ways.
    """

    def __init__(self, world: VirtualWorld, faults: LinkFaults, page: LineEnd) -> None:
        self.to_server = Direction(world, faults, "to the server")
        self.to_page = Direction(world, faults, "to the page")
        self.to_page.end = page

    def abort(self, side: Direction) -> None:
        """End it on the side that `side` leads to: nothing more comes there, the other is told."""
        other = self.to_page if side is self.to_server else self.to_server
        side.end = None
        other.close()


class Direction:
    """One way of a connection: what is lost is sent again, and all behind it waits.

    Parameters
    ----------
    world : VirtualWorld
        Its time and chance.
    faults : LinkFaults
        What happens on the line.
    name : str
        Which way it is.

    Attributes
    ----------
    end : LineEnd or None
        Where it leads.
    """

    def __init__(self, world: VirtualWorld, faults: LinkFaults, name: str) -> None:
        self._world = world
        self._faults = faults
        self._way = Way(world, _WAY_NS, PAGE_LINE, name)
        # None: nothing follows.
        self._waiting: deque[str | None] = deque()
        self._arrival_ns = 0
        self._closed = False
        self.end: LineEnd | None = None

    def send(self, text: str) -> None:
        """Send a message."""
        self._put(text)

    def close(self) -> None:
        """Send that nothing follows."""
        self._put(None)
        self._closed = True

    def _put(self, text: str | None) -> None:
        if self._closed:
            return
        self._waiting.append(text)
        if len(self._waiting) == 1:
            self._send_waiting()

    def _send_waiting(self) -> None:
        while self._waiting:
            deliveries = self._faults.deliveries(PAGE_LINE, b"", self._way)
            if not deliveries:
                late_ns = self._way.faults.randint(*_RESEND_NS)
                self._world.call_after(late_ns, self._send_waiting)
                return
            text = self._waiting.popleft()
            late_ns = self._way.takes_ns() + deliveries[0].late_ns
            self._arrival_ns = max(self._arrival_ns, self._world.steady_ns + late_ns)
            self._world.call_at(self._arrival_ns, partial(self._arrive, text))

    def _arrive(self, text: str | None) -> None:
        end = self.end
        if end is None:
            return
        if text is None:
            self.end = None
            end.see_end()
        else:
            end.hear(text)


class VirtualLine:
    """The way from pages to who serves them.

    Parameters
    ----------
    world : VirtualWorld
        Its time and chance.
    faults : LinkFaults
        What happens on it, on `PAGE_LINE`.

    Attributes
    ----------
    accept : callable or None
        Takes a connection that a page opens, and returns the server's end; None: nobody listens.
    """

    def __init__(self, world: VirtualWorld, faults: LinkFaults) -> None:
        self._world = world
        self._faults = faults
        self.accept: Callable[[Connection], LineEnd] | None = None

    def connect(self, page: LineEnd) -> Connection:
        """Open a connection; where nobody listens it ends before it has begun."""
        connection = Connection(self._world, self._faults, page)
        if self.accept is None:
            connection.to_page.close()
        else:
            connection.to_server.end = self.accept(connection)
        return connection
