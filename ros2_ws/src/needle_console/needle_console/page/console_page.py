"""One browser's page: laid out once, then told what has changed."""

from __future__ import annotations

import json

from nicegui import ui

from needle_console.page.controls import Controls
from needle_console.page.desk import Desk
from needle_console.page.needle_scene import NeedleScene
from needle_console.page.status_bar import StatusBar
from needle_console.view.camera_feed import SIDES
from needle_console.view.chart import chart
from needle_console.view.snapshot import Snapshot

_TEXT_PERIOD, _DRAWING_PERIOD = 0.2, 0.5
_HEAD = """
<link rel="stylesheet" href="/static/console.css">
<script type="module">
  import { startPage } from "/static/page.js";
  startPage(OPTIONS);
</script>
"""


class ConsolePage:
    """Builds the page of the client that NiceGUI serves at the moment.

    Parameters
    ----------
    desk : Desk
        The rig.
    hold_port : int
        Of the hold's own server, on the host that the page came from.
    """

    def __init__(self, desk: Desk, hold_port: int) -> None:
        self._desk = desk
        options = json.dumps({"port": hold_port, "speed": Controls.SPEED})
        ui.add_head_html(_HEAD.replace("OPTIONS", options))
        ui.dark_mode(None)
        with ui.element("main").classes("console"):
            # First in the order of the keyboard; the style sheet says where they stand.
            self._controls = Controls(desk)
            self._status = StatusBar()
            for side in SIDES:
                with ui.element("figure").classes(f"tile view-{side}"):
                    ui.html(
                        f'<img data-view="{side}" alt="{side} camera, tip and shaft drawn in">'
                        f"<figcaption>{side} camera</figcaption>",
                        sanitize=False,
                    )
            self._scene = NeedleScene()
            with ui.element("figure").classes("tile chart"):
                self._chart = ui.html(chart(Snapshot()), sanitize=False).classes("drawing")
        self._refresh_text()
        self._refresh_drawings()
        ui.timer(_TEXT_PERIOD, self._refresh_text)
        ui.timer(_DRAWING_PERIOD, self._refresh_drawings)

    def _refresh_text(self) -> None:
        snapshot = self._desk.snapshot()
        self._controls.show(snapshot)
        self._status.show(snapshot)

    def _refresh_drawings(self) -> None:
        snapshot = self._desk.snapshot()
        self._scene.show(snapshot)
        self._chart.set_content(chart(snapshot))
