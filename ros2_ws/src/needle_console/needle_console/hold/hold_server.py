"""The hold's own thread: WebSockets on a port of its own, beside the page's event loop."""

from __future__ import annotations

import asyncio
import contextlib
import http
import ipaddress
import json
import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from needle_common.errors import UserError
from needle_console.access.access import Access
from needle_console.access.rate_limit import RateLimit
from needle_console.hold.hold_arbiter import HoldArbiter
from needle_console.hold.hold_state import RELEASED, HoldState
from needle_console.hold.page_message import LONGEST, GarbageError, read_token
from needle_console.hold.refusals import Refusal, Refusals

PERIOD = 0.02
"""Nonces go to every page, and the hold's state to its taker, so often [s]."""

ALONE_PERIOD = 0.08
"""Without a page nobody can press: the release is only repeated, above 10 times a second [s]."""

PATH = "/hold"
_MOST_CONNECTIONS = 32
# From TCP's first packet to a request, and from there to a token [s].
_PATIENCE = 1.0
# By so much later than a hold's end it is looked at [s].
_TICK = 1e-4
# A page answers 50 times a second, and when its button changes.
_RATE, _BURST = 100.0, 50
_POLICY_VIOLATION, _TOO_BIG = 1008, 1009


class HoldServer:
    """Serves the hold's protocol, `docs/safety.md`, and hands on the hold that counts.

    Parameters
    ----------
    access : Access
        Who may connect.
    port : int
        Port to listen on; 0 takes any that is free.
    on_state : callable
        Takes the hold every `PERIOD`, without a page every `ALONE_PERIOD`, and at once when it
        changes; called by the hold's thread, which must not be kept waiting.
    on_notice : callable
        Takes a line that is worth a warning; called by the hold's thread.

    Raises
    ------
    UserError
        If the port cannot be had.
    """

    def __init__(
        self,
        access: Access,
        port: int,
        on_state: Callable[[HoldState], None],
        on_notice: Callable[[str], None],
    ) -> None:
        self._access = access
        self._on_state = on_state
        self._on_notice = on_notice
        self._refusals = Refusals()
        self._arbiter = HoldArbiter(lambda: secrets.token_hex(8))
        self._told = RELEASED
        self._connections = 0
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
        return self._refusals.counts()

    # ---- the thread ---------------------------------------------------------------------------

    async def _serve(self) -> None:
        # What it says of every broken connection is counted here.
        silent = logging.Logger("hold", logging.CRITICAL + 1)
        server = serve(
            self._serve_connection,
            sock=self._socket,
            process_request=self._judge_request,
            compression=None,
            server_header=None,
            open_timeout=_PATIENCE,
            # Pages are asked for life signs by their nonces.
            ping_interval=None,
            close_timeout=_PATIENCE,
            max_size=LONGEST,
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
        due = time.monotonic()
        while True:
            self._called.clear()
            now = time.monotonic()
            period = PERIOD if self._arbiter.has_pages else ALONE_PERIOD
            # Sooner than was meant where the first page has come.
            due = min(due, now + period)
            if now >= due or (self._told.pressed and now > self._arbiter.until):
                self._tell()
                while due <= now:
                    due += period
            wait = min(due, max(self._arbiter.until, now) + _TICK) if self._told.pressed else due
            # Its own timer, and no task for each wait: that was half of what an idle console cost.
            timer = self._loop.call_later(wait - now, self._called.set)
            await self._called.wait()
            timer.cancel()
            if self._is_ended:
                return

    def _tell(self) -> None:
        now = time.monotonic()
        if self._arbiter.lapses(now):
            self._refuse(Refusal.LOST, "no fresh word of the page; it takes a new press")
        self._told = self._arbiter.state(now)
        self._on_state(self._told)

    def _tell_change(self) -> None:
        if self._arbiter.state(time.monotonic()) != self._told:
            self._tell()

    def _refuse(self, refusal: Refusal, detail: str = "") -> None:
        if self._refusals.count(refusal):
            self._on_notice(f"hold: {refusal.value}" + (f" ({detail})" if detail else ""))

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
        elif self._connections >= _MOST_CONNECTIONS:
            refusal = Refusal.CONNECTIONS
        if refusal is None:
            return None
        self._refuse(refusal)
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal.value}\n")

    async def _serve_connection(self, connection: ServerConnection) -> None:
        self._connections += 1
        try:
            if await self._knows_token(connection):
                await self._serve_page(connection)
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code == _TOO_BIG:
                self._refuse(Refusal.SIZE)
        finally:
            self._connections -= 1

    async def _knows_token(self, connection: ServerConnection) -> bool:
        try:
            token = read_token(await asyncio.wait_for(connection.recv(), _PATIENCE))
        except asyncio.TimeoutError:
            return await self._close(connection, Refusal.NO_TOKEN)
        except GarbageError:
            return await self._close(connection, Refusal.GARBAGE)
        if not self._access.token_is_right(token):
            return await self._close(connection, Refusal.TOKEN)
        return True

    async def _close(self, connection: ServerConnection, refusal: Refusal) -> bool:
        """Close a connection for a reason; returns False."""
        self._refuse(refusal)
        await connection.close(_POLICY_VIOLATION, refusal.value)
        return False

    async def _serve_page(self, connection: ServerConnection) -> None:
        page = self._arbiter.open(time.monotonic())
        if page is None:
            await self._close(connection, Refusal.PAGES)
            return
        self._called.set()
        sending = asyncio.ensure_future(self._send_nonces(connection, page))
        try:
            await self._hear(connection, page)
        finally:
            # First of all: what a gone page held ends now.
            self._arbiter.close(page)
            self._tell_change()
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await sending

    async def _hear(self, connection: ServerConnection, page: int) -> None:
        limit = RateLimit(_RATE, _BURST)
        async for data in connection:
            now = time.monotonic()
            if not limit.lets_through(now):
                self._refuse(Refusal.RATE)
                # Whoever floods is not waited for.
                connection.transport.abort()
                return
            # A silence that nobody watched is one all the same.
            if self._arbiter.lapses(now):
                self._refuse(Refusal.LOST)
            refusal = self._arbiter.receive(page, data, now)
            if refusal is not None:
                self._refuse(refusal)
            self._tell_change()

    async def _send_nonces(self, connection: ServerConnection, page: int) -> None:
        while True:
            now = time.monotonic()
            if self._arbiter.is_silent(page, now):
                self._refuse(Refusal.SILENT)
                connection.transport.abort()
                return
            nonce = self._arbiter.issue(page, now)
            if nonce is not None:
                await connection.send(json.dumps({"nonce": nonce, **self._arbiter.tell(page, now)}))
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
