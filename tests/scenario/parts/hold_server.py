"""The console's hold protocol with a page, without sockets and threads."""

from __future__ import annotations

from collections.abc import Sequence

from needle_console.console import PAGE, HoldRequest
from needle_console.hold.hold_protocol import PERIOD, HoldProtocol
from needle_console.hold.page_session import PageHold
from needle_core.component import Action, Actions, Component, Log, Moment, Port, Send, Timer
from scenario.faults import PAGE_LINE
from scenario.parts.page import CONNECT, PageMessage

_POLL_PERIOD = 0.005


class VirtualHoldServer(Component):
    """Serves the hold as `hold.hold_server` does; the console receives it at its port."""

    name = "hold_server"

    def __init__(self) -> None:
        self._actions: list[Action] = []
        self._protocol = HoldProtocol(lambda _: "", self._publish_state, self._notice, 0.0)
        # Connection to page number.
        self._pages: dict[int, int] = {}
        self.ports = (Port(PAGE_LINE, self._handle_batch), Port(PAGE, lambda *_: ()))
        self.timers = (Timer(_POLL_PERIOD, self._poll), Timer(PERIOD, self._send_counts))

    def _publish_state(self, state: PageHold) -> None:
        self._actions.append(Send(PAGE, (HoldRequest(state, self._protocol.counts()),)))

    def _notice(self, text: str) -> None:
        self._actions.append(Log("warning", text))

    def _pending_actions(self) -> Actions:
        actions, self._actions = self._actions, []
        return actions

    def _poll(self, at: Moment) -> Actions:
        self._protocol.update(at.steady)
        return self._pending_actions()

    def _handle_batch(self, batch: Sequence[PageMessage], at: Moment) -> Actions:
        for message in batch:
            yield from self._handle_message(message, at.steady)
        yield from self._pending_actions()

    def _handle_message(self, message: PageMessage, now: float) -> Actions:
        page = self._pages.get(message.connection)
        if message.text is None:
            # End the hold of a closed page first.
            if page is not None:
                self._close(message.connection, now)
        elif page is not None:
            self._protocol.receive(page, message.text, now)
        elif message.text == CONNECT:
            self._pages[message.connection] = self._protocol.open(now, is_local=True)
        else:
            # Unknown connection, as after a restart.
            yield self._abort(message.connection, now)

    def _send_counts(self, at: Moment) -> Actions:
        for connection, page in tuple(self._pages.items()):
            if self._protocol.is_silent(page, at.steady):
                yield self._abort(connection, at.steady)
            else:
                word = self._protocol.message_for(page, at.steady)
                yield Send(PAGE_LINE, (PageMessage(connection, word),))
        yield from self._pending_actions()

    def _abort(self, connection: int, now: float) -> Action:
        if connection in self._pages:
            self._close(connection, now)
        return Send(PAGE_LINE, (PageMessage(connection),))

    def _close(self, connection: int, now: float) -> None:
        self._protocol.close(self._pages.pop(connection), now)
