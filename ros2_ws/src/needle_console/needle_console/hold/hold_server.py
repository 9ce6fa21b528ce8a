"""The hold's own thread: WebSockets on a port of its own, beside the page's event loop."""

from __future__ import annotations

import asyncio
import contextlib
import http
import ipaddress
import logging
import socket
import threading
import time
from collections.abc import Callable

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from needle_console.access.access import Access
from needle_console.hold.hold_state import HoldState
from needle_console.hold.hold_talk import PERIOD, HoldTalk
from needle_console.hold.refusals import Refusal
from needle_core.errors import UserError

PATH = "/hold"
# From TCP's first packet to a request [s].
_PATIENCE = 1.0


class HoldServer:
    """Serves the hold's protocol, `docs/safety.md`, and hands on the hold that counts.

    Parameters
    ----------
    access : Access
        Who may connect.
    port : int
        Port to listen on; 0 takes any that is free.
    why_not, on_state, on_notice : callable
        As of `HoldTalk`; called by the hold's thread, which must not be kept waiting.

    Raises
    ------
    UserError
        If the port cannot be had.
    """

    def __init__(
        self,
        access: Access,
        port: int,
        why_not: Callable[[bool], str],
        on_state: Callable[[HoldState], None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._access = access
        self._talk = HoldTalk(why_not, on_state, on_notice, time.monotonic())
        self._socket = _listen(access.address, port)
        self._loop = asyncio.new_event_loop()
        self._called = asyncio.Event()
        self._is_ended = False
        self._thread = threading.Thread(
            target=lambda: self._loop.run_until_complete(self._serve()), name="hold", daemon=True
        )

    @property
    def port(self) -> int:
        """Port that is listened on."""
        return int(self._socket.getsockname()[1])

    @property
    def is_alive(self) -> bool:
        """Whether the hold is served."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Release the hold and end; the release is the last that is handed on."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._end)
            self._thread.join()
        self._loop.close()
        self._socket.close()

    def counts(self) -> dict[str, int]:
        """Return how often what was refused or lost."""
        return self._talk.refusals.counts()

    # ---- the thread ---------------------------------------------------------------------------

    async def _serve(self) -> None:
        # What it says of every broken connection is counted here.
        silent = logging.Logger("hold", logging.CRITICAL + 1)
        server = serve(
            self._serve_page,
            sock=self._socket,
            process_request=self._judge_request,
            compression=None,
            server_header=None,
            open_timeout=_PATIENCE,
            # Pages are asked for life signs by the counts.
            ping_interval=None,
            close_timeout=_PATIENCE,
            logger=silent,
        )
        async with server as serving:
            await self._hand_on()
            # Nobody is waited for.
            for connection in serving.connections:
                connection.transport.abort()

    def _end(self) -> None:
        self._is_ended = True
        self._called.set()

    async def _hand_on(self) -> None:
        """Hand on the hold once at least, until the end: at fixed times, and when it runs out."""
        while True:
            self._called.clear()
            now = time.monotonic()
            again = self._talk.look(now)
            # Its own timer, and no task for each wait: that was half of what an idle console cost.
            timer = self._loop.call_later(again - now, self._called.set)
            await self._called.wait()
            timer.cancel()
            if self._is_ended:
                return

    # ---- a connection -------------------------------------------------------------------------

    def _judge_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse foreign pages before anything is exchanged."""
        hosts = request.headers.get_all("Host")
        origins = request.headers.get_all("Origin")
        refusal = None
        if len(hosts) != 1 or self._access.why_not_host(hosts[0]):
            refusal = Refusal.HOST
        elif len(origins) != 1 or self._access.why_not_origin(origins[0]):
            refusal = Refusal.ORIGIN
        elif request.path != PATH:
            refusal = Refusal.PATH
        if refusal is None:
            return None
        self._talk.refuse(refusal)
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal.value}\n")

    async def _serve_page(self, connection: ServerConnection) -> None:
        # A machine that connects to itself has one address at both ends.
        is_local = connection.remote_address[0] == connection.local_address[0]
        page = self._talk.open(time.monotonic(), is_local=is_local)
        self._called.set()
        sending = asyncio.ensure_future(self._send_counts(connection, page))
        try:
            async for data in connection:
                self._talk.hear(page, data, time.monotonic())
        except ConnectionClosed:
            pass
        finally:
            # First of all: what a gone page held ends now.
            self._talk.close(page, time.monotonic())
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await sending

    async def _send_counts(self, connection: ServerConnection, page: int) -> None:
        while True:
            now = time.monotonic()
            if self._talk.has_lost(page, now):
                connection.transport.abort()
                return
            await connection.send(self._talk.word_for(page, now))
            await asyncio.sleep(PERIOD)


def _listen(address: str, port: int) -> socket.socket:
    family = socket.AF_INET
    with contextlib.suppress(ValueError):
        if ipaddress.ip_address(address).version == 6:
            family = socket.AF_INET6
    try:
        return socket.create_server((address, port), family=family)
    except OSError as error:
        raise UserError(f"hold: {address} port {port}: {error.strerror}") from error
