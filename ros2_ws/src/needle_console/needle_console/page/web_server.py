"""Servers of page and hold, each in a thread and loop of its own."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, Response
from nicegui import app, ui

from needle_console.access.access import Access
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.hold_server import HoldServer
from needle_console.page.console_page import ConsolePage
from needle_console.page.desk import Desk
from needle_console.page.gate import Gate
from needle_console.view.camera_feed import SIDES
from needle_core.component import Batch
from needle_core.errors import UserError

STATIC = Path(__file__).resolve().parents[1] / "static"
# So long a page has to hear that the end has come; then without it, and at last by force [s].
_PATIENCE, _JOIN = 0.2, 1.0


class WebServer:
    """The page's server; one a process, for NiceGUI is one.

    Parameters
    ----------
    desk : Desk
        What the pages show and do.
    access : Access
        Who may open one.
    address : str
        Where to listen.
    port : int
        0 takes any that is free.
    hold_port : int
        Where the page's hold connects to.

    Raises
    ------
    UserError
        The port is taken, or the address is none of this machine's.
    """

    def __init__(
        self, desk: Desk, access: Access, *, address: str, port: int, hold_port: int
    ) -> None:
        self._socket = _listen(address, port)
        self.port = int(self._socket.getsockname()[1])
        server = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

        def picture(side: str) -> Response:
            data = desk.picture(side) if side in SIDES else None
            if data is None:
                return Response(status_code=204)
            return Response(data, media_type="image/jpeg", headers={"cache-control": "no-store"})

        server.get("/view/{side}.jpg")(picture)
        app.add_static_files("/static", str(STATIC), max_cache_age=0)
        ui.page("/", title="Needle console")(lambda: ConsolePage(desk, hold_port))
        ui.run_with(server, dark=None, show_welcome_message=False, reconnect_timeout=3.0)
        server.add_middleware(Gate, access=access)
        self._server = uvicorn.Server(
            uvicorn.Config(
                server,
                log_level="warning",
                access_log=False,
                log_config=None,
                timeout_graceful_shutdown=_PATIENCE,
            )
        )
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Stop serving; open pages see that nobody answers."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(_JOIN)
        with contextlib.suppress(OSError):
            self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])


class ServedDesk(Desk):
    """The desk with its servers of page and hold.

    Parameters
    ----------
    settings : ConsoleParameters
        Where they listen, and to whom.

    Raises
    ------
    UserError
        A setting that cannot be, or a port that is taken.
    """

    def __init__(self, settings: ConsoleParameters) -> None:
        super().__init__(settings)
        self._at = f"http://{settings.address}:{settings.port}/"
        access = settings.access()
        self._hold_server = HoldServer(
            access, settings.hold_port, self.why_no_hold, self.hold, self.notice
        )
        self.refused = self._hold_server.counts
        try:
            self._page_server = WebServer(
                self,
                access,
                address=settings.address,
                port=settings.port,
                hold_port=settings.hold_port,
            )
        except UserError:
            self._hold_server.close()
            raise

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Begin to serve."""
        super().open(arrive)
        self._hold_server.start()
        self._page_server.start()
        self.notice(f"page on {self._at}", "info")

    def close(self) -> None:
        """Release the hold, then end both."""
        self._hold_server.close()
        self._page_server.close()


def _listen(address: str, port: int) -> socket.socket:
    family: Any = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        # Whoever comes before the server has begun waits, and is not refused.
        return socket.create_server((address, port), family=family)
    except OSError as error:
        raise UserError(f"cannot listen on {address}:{port}: {error.strerror}") from error
