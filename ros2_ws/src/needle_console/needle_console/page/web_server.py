"""Servers of page and hold, each with its own thread and event loop."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path

import uvicorn
from fastapi import FastAPI, Response
from nicegui import app, ui

from needle_console.access import Access, Gate, listening_socket
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.hold_server import HoldServer
from needle_console.page.console_page import ConsolePage
from needle_console.page.page_port import PagePort
from needle_console.view.camera_view import SIDES
from needle_core.component import Batch
from needle_core.errors import UserError

STATIC = Path(__file__).resolve().parents[1] / "static"
# Time limits for closing open connections, and for the end of the thread [s].
_SHUTDOWN_TIMEOUT, _JOIN_TIMEOUT = 0.2, 1.0


class WebServer:
    """Server of the page; a process can have only one, because NiceGUI is a singleton.

    Parameters
    ----------
    page_port : PagePort
        The port to the component.
    access : Access
        Checks the connections.
    address : str
        Address to listen on.
    port : int
        Port to listen on; 0 selects a free one.
    hold_port : int
        Port of the hold's server.

    Raises
    ------
    UserError
        If the port is taken, or the address does not belong to this machine.
    """

    def __init__(
        self, page_port: PagePort, access: Access, *, address: str, port: int, hold_port: int
    ) -> None:
        self._socket = listening_socket(address, port)
        self.port = int(self._socket.getsockname()[1])
        server = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

        def view(side: str) -> Response:
            data = page_port.view(side) if side in SIDES else None
            if data is None:
                return Response(status_code=204)
            return Response(data, media_type="image/jpeg", headers={"cache-control": "no-store"})

        server.get("/view/{side}.jpg")(view)
        app.add_static_files("/static", str(STATIC), max_cache_age=0)
        ui.page("/", title="Needle console")(lambda: ConsolePage(page_port, hold_port))
        ui.run_with(server, dark=None, show_welcome_message=False, reconnect_timeout=3.0)
        server.add_middleware(Gate, access=access)
        self._server = uvicorn.Server(
            uvicorn.Config(
                server,
                log_level="warning",
                access_log=False,
                log_config=None,
                timeout_graceful_shutdown=_SHUTDOWN_TIMEOUT,
            )
        )
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the server."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(_JOIN_TIMEOUT)
        with contextlib.suppress(OSError):
            self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])


class ServedPagePort(PagePort):
    """Port with the servers of page and hold.

    Parameters
    ----------
    settings : ConsoleParameters
        Addresses and access.

    Raises
    ------
    UserError
        If a setting is invalid, or a port is taken.
    """

    def __init__(self, settings: ConsoleParameters) -> None:
        super().__init__(settings)
        self._url = f"http://{settings.address}:{settings.port}/"
        access = settings.access()
        self._hold_server = HoldServer(
            access, settings.hold_port, self.hold_refusal, self.set_hold, self.log
        )
        self.refusals = self._hold_server.counts
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
        """Start both servers."""
        super().open(arrive)
        self._hold_server.start()
        self._page_server.start()
        self.log(f"page on {self._url}", "info")

    def close(self) -> None:
        """Release the hold, then stop both servers."""
        self._hold_server.close()
        self._page_server.close()
