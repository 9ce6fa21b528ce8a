"""The console's hold on a virtual line: its real talk, without sockets and without a thread."""

from __future__ import annotations

import math
from collections.abc import Callable

from needle_console.access.access import Access
from needle_console.hold.hold_state import HoldState
from needle_console.hold.hold_talk import PERIOD, HoldTalk
from needle_console.hold.page_message import GarbageError, read_token
from needle_console.hold.refusals import Refusal
from needle_verification.soak.virtual_line import Connection, VirtualLine
from needle_verification.soak.virtual_timers import VirtualAlarm
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualProcess

_PERIOD_NS = round(PERIOD * NANOSECONDS)


class VirtualHold:
    """Serves the hold as `HoldServer` does, beside the node's own thread.

    Parameters
    ----------
    process : VirtualProcess
        The console's.
    line : VirtualLine
        Where pages come from.
    access : Access
        Who may connect: a page that has its token.
    on_state, on_notice : callable
        As of `HoldTalk`.
    """

    def __init__(
        self,
        process: VirtualProcess,
        line: VirtualLine,
        access: Access,
        on_state: Callable[[HoldState], None],
        on_notice: Callable[[str], None],
    ) -> None:
        self.process = process
        self.access = access
        chance = process.world.chance("nonces")
        self.talk = HoldTalk(
            lambda: f"{chance.getrandbits(64):016x}", on_state, on_notice, process.world.steady
        )
        self._line = line
        self._connections: list[_Served] = []
        self._alarm = VirtualAlarm(process.world, process.do_concurrently, self.look)

    @property
    def is_alive(self) -> bool:
        """Whether the hold is served."""
        return self.process.alive

    def counts(self) -> dict[str, int]:
        """Return how often what was refused or lost."""
        return self.talk.refusals.counts()

    def start(self) -> None:
        """Begin to serve."""
        self._line.accept = self._accept
        self.look()

    def close(self) -> None:
        """End, as the kernel ends it for a process that is gone."""
        self._line.accept = None
        for served in self._connections:
            served.connection.abort(served.connection.to_server)

    def look(self) -> None:
        """Hand on the hold, and plan to look again."""
        world = self.process.world
        again_ns = math.ceil(self.talk.look(world.steady) * NANOSECONDS)
        # Time in seconds is rounded: a look that is due by less than that would not end.
        self._alarm.set(max(again_ns, world.steady_ns + 1))

    def _accept(self, connection: Connection) -> _Served:
        served = _Served(self, connection)
        self._connections.append(served)
        return served


class _Served:
    """The console's end of a connection."""

    def __init__(self, hold: VirtualHold, connection: Connection) -> None:
        self._hold = hold
        self.connection = connection
        self._page: int | None = None

    def hear(self, text: str) -> None:
        self._hold.process.do_concurrently(lambda: self._hear(text))

    def see_end(self) -> None:
        self._hold.process.do_concurrently(self._end)

    @property
    def _now(self) -> float:
        return self._hold.process.world.steady

    def _hear(self, text: str) -> None:
        if self._page is None:
            self._let_in(text)
        elif not self._hold.talk.hear(self._page, text, self._now):
            self._abort()

    def _let_in(self, text: str) -> None:
        talk = self._hold.talk
        try:
            if not self._hold.access.token_is_right(read_token(text)):
                talk.refuse(Refusal.TOKEN)
                self._abort()
                return
        except GarbageError:
            talk.refuse(Refusal.GARBAGE)
            self._abort()
            return
        self._page = talk.open(self._now)
        if self._page is None:
            talk.refuse(Refusal.PAGES)
            self._abort()
            return
        self._hold.look()
        self._send_nonce()

    def _send_nonce(self) -> None:
        if self._page is None:
            return
        if self._hold.talk.has_lost(self._page, self._now):
            self._abort()
            return
        word = self._hold.talk.word_for(self._page, self._now)
        if word is not None:
            self.connection.to_page.send(word)
        process = self._hold.process
        process.world.call_after(_PERIOD_NS, lambda: process.do_concurrently(self._send_nonce))

    def _abort(self) -> None:
        self.connection.abort(self.connection.to_server)
        self._end()

    def _end(self) -> None:
        # First of all: what a gone page held ends now.
        page, self._page = self._page, None
        if page is not None:
            self._hold.talk.close(page, self._now)
