"""The console's hold alone: its server, its script on a page of one button, its topic.

`python -m needle_verification.ros.console.console_stand_in` prints the ports of page and hold, and
runs until its input ends.
"""

from __future__ import annotations

import http.server
import json
import sys
import threading
from http import HTTPStatus
from pathlib import Path

import rclpy

import needle_console
from needle_common.ros.whole_node import WholeNode
from needle_console.access.access import Access
from needle_console.hold.hold_server import HoldServer
from needle_console.hold.hold_state import HoldState
from needle_console.ros.hold_topic import HoldTopic

BUTTON = (100.0, 50.0)
"""Middle of the page's button [px]."""

TOKEN = "known to this page alone"

_ADDRESS = "127.0.0.1"
_PAGE = """<!doctype html>
<title>hold</title>
<button data-hold="insert" style="position: fixed; left: 0; top: 0; width: 200px; height: 100px">
  hold to insert
</button>
<iframe srcdoc="elsewhere" style="position: fixed; left: 0; top: 200px"></iframe>
<script type="module">
  import { startHold } from "/hold.js";
  const port = Number(new URLSearchParams(location.search).get("port"));
  window.needleHold = startHold({ port, token: "%s", speed: 1.0 });
</script>
"""


class _Page(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/":
            self._answer("text/html", _PAGE.replace("%s", TOKEN))
        elif path == "/hold.js":
            script = Path(needle_console.__path__[0]) / "static" / "hold.js"
            self._answer("text/javascript", script.read_text("utf-8"))
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, *_: object) -> None:
        """Say nothing of requests."""

    def _answer(self, kind: str, text: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.end_headers()
        self.wfile.write(text.encode())


def main() -> int:
    """Serve until the input ends; returns the exit code."""
    rclpy.init(args=[])
    node = WholeNode("console_stand_in")
    topic = HoldTopic(node)

    def publish(state: HoldState) -> None:
        topic.publish(pressed=state.pressed, speed=state.speed)

    with http.server.ThreadingHTTPServer((_ADDRESS, 0), _Page) as pages:
        serving = threading.Thread(target=pages.serve_forever)
        serving.start()
        access = Access(_ADDRESS, pages.server_port, TOKEN)
        hold = HoldServer(access, 0, publish, node.get_logger().warning)
        hold.start()
        print(json.dumps({"page": pages.server_port, "hold": hold.port}), flush=True)
        sys.stdin.read()
        hold.close()
        pages.shutdown()
        serving.join()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
