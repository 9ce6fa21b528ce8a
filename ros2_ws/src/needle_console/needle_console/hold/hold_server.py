"""Server of the hold: WebSockets on a separate port, in a thread separate from the page's."""

from __future__ import annotations

import asyncio
import contextlib
import http
import logging
import threading
import time
from collections.abc import Callable

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from needle_console.access import Access, listening_socket
from needle_console.hold.hold_protocol import PERIOD, HoldProtocol
from needle_console.hold.page_session import HoldRefusal, PageHold

PATH = "/hold"
# Time limit for a handshake, and for closing [s].
_TIMEOUT = 1.0


class HoldServer:
    """Server of the hold's protocol (docs/safety.md) that reports the valid hold.

    Parameters
    ----------
    access : Access
        Checks the connections.
    port : int
        Port to listen on; 0 selects a free one.
    refusal_reason, on_state, on_notice : callable
        As for `HoldProtocol`; the hold's thread calls them, so they must not block.

    Raises
    ------
    UserError
        If the port is taken.
    """

    def __init__(
        self,
        access: Access,
        port: int,
        refusal_reason: Callable[[bool], str],
        on_state: Callable[[PageHold], None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._access = access
        self._protocol = HoldProtocol(refusal_reason, on_state, on_notice, time.monotonic())
        self._socket = listening_socket(access.address, port)
        self._loop = asyncio.new_event_loop()
        self._woken = asyncio.Event()
        self._is_ended = False
        self._thread = threading.Thread(
            target=lambda: self._loop.run_until_complete(self._serve()), name="hold", daemon=True
        )

    @property
    def port(self) -> int:
        """Port of the server."""
        return int(self._socket.getsockname()[1])

    @property
    def is_alive(self) -> bool:
        """Whether the server runs."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Close all connections and end the thread; the last reported hold is a release."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._end)
            self._thread.join()
        self._loop.close()
        self._socket.close()

    def counts(self) -> dict[str, int]:
        """Return the number of refusals of each kind."""
        return self._protocol.counts()

    # ---- the thread ---------------------------------------------------------------------------

    async def _serve(self) -> None:
        # The protocol counts broken connections; websockets would log each one.
        silent = logging.Logger("hold", logging.CRITICAL + 1)
        server = serve(
            self._serve_page,
            sock=self._socket,
            process_request=self._check_request,
            compression=None,
            server_header=None,
            open_timeout=_TIMEOUT,
            # The counts serve as pings.
            ping_interval=None,
            close_timeout=_TIMEOUT,
            logger=silent,
        )
        async with server as serving:
            await self._report_holds()
            for connection in serving.connections:
                connection.transport.abort()

    def _end(self) -> None:
        self._is_ended = True
        self._woken.set()

    async def _report_holds(self) -> None:
        """Report the hold at least once, at fixed times and when it expires, until the end."""
        while True:
            self._woken.clear()
            now = time.monotonic()
            next_time = self._protocol.update(now)
            # Use one timer: a task for each wait would double the load of an idle console.
            timer = self._loop.call_later(next_time - now, self._woken.set)
            await self._woken.wait()
            timer.cancel()
            if self._is_ended:
                return

    # ---- a connection -------------------------------------------------------------------------

    def _check_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse foreign pages before the handshake."""
        hosts = request.headers.get_all("Host")
        origins = request.headers.get_all("Origin")
        refusal = None
        if len(hosts) != 1 or self._access.host_refusal(hosts[0]):
            refusal = HoldRefusal.HOST
        elif len(origins) != 1 or self._access.origin_refusal(origins[0]):
            refusal = HoldRefusal.ORIGIN
        elif request.path != PATH:
            refusal = HoldRefusal.PATH
        if refusal is None:
            return None
        self._protocol.refuse(refusal)
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal.value}\n")

    async def _serve_page(self, connection: ServerConnection) -> None:
        # On this machine, both ends of a connection have the same address.
        is_local = connection.remote_address[0] == connection.local_address[0]
        page = self._protocol.open(time.monotonic(), is_local=is_local)
        self._woken.set()
        sending = asyncio.ensure_future(self._send_counts(connection, page))
        try:
            async for data in connection:
                self._protocol.receive(page, data, time.monotonic())
        except ConnectionClosed:
            pass
        finally:
            # End the page's hold first.
            self._protocol.close(page, time.monotonic())
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await sending

    async def _send_counts(self, connection: ServerConnection, page: int) -> None:
        while True:
            now = time.monotonic()
            if self._protocol.is_silent(page, now):
                connection.transport.abort()
                return
            await connection.send(self._protocol.message_for(page, now))
            await asyncio.sleep(PERIOD)
