"""Page with one button and the console's hold, like any page of the console."""

from __future__ import annotations

import contextlib
import http.server
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import needle_console
from needle_console.access import Access
from needle_console.hold.hold_server import HoldServer
from needle_console.hold.page_session import PageHold

BUTTON = (100.0, 50.0)
"""Middle of the page's button [px]."""

_ADDRESS = "127.0.0.1"
_PAGE = """<!doctype html>
<title>hold</title>
<button data-hold="insert" style="position: fixed; left: 0; top: 0; width: 200px; height: 100px">
  hold to insert
</button>
<input style="position: fixed; left: 300px; top: 0">
<iframe srcdoc="elsewhere" style="position: fixed; left: 0; top: 200px"></iframe>
<script type="module">
  import { startHold } from "/hold.js";
  const port = Number(new URLSearchParams(location.search).get("port"));
  window.needleHold = startHold({ port, speed: 1.0 });
</script>
"""


@contextlib.contextmanager
def serve_button_page(
    on_state: Callable[[PageHold], None], on_notice: Callable[[str], None]
) -> Iterator[tuple[int, HoldServer]]:
    """Serve the page; yields its port and the hold server.

    Parameters
    ----------
    on_state, on_notice : callable
        Callbacks of `HoldServer`.
    """
    with (
        tempfile.TemporaryDirectory(prefix="needle_page_") as folder,
        http.server.ThreadingHTTPServer((_ADDRESS, 0), partial(_Page, directory=folder)) as pages,
    ):
        Path(folder, "index.html").write_text(_PAGE, "utf-8")
        shutil.copy(Path(needle_console.__path__[0]) / "static" / "hold.js", folder)
        serving = threading.Thread(target=pages.serve_forever)
        serving.start()
        access = Access(_ADDRESS, pages.server_port)
        hold = HoldServer(access, 0, lambda _: "", on_state, on_notice)
        hold.start()
        try:
            yield pages.server_port, hold
        finally:
            hold.close()
            pages.shutdown()
            serving.join()


class _Page(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Do not log requests."""
