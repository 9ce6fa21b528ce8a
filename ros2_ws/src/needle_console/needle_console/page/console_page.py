"""Page of one browser, which is built once and then updated."""

from __future__ import annotations

import json

from nicegui import ui

from needle_console.page.controls import Controls
from needle_console.page.needle_scene import NeedleScene
from needle_console.page.page_port import PagePort
from needle_console.view.camera_view import SIDES
from needle_console.view.drawings import chart, dial
from needle_console.view.readings import readings
from needle_console.view.snapshot import Snapshot

_TEXT_PERIOD, _DRAWING_PERIOD = 0.2, 0.5
_NO_STATUS = "not heard"
_HEAD = """
<link rel="stylesheet" href="/static/console.css">
<script type="module">
  import { startPage } from "/static/page.js";
  startPage(OPTIONS);
</script>
"""


class ConsolePage:
    """Page of the client that NiceGUI is currently serving.

    Parameters
    ----------
    port : PagePort
        The port to the component.
    hold_port : int
        TCP port of the hold's server, on the host of the page.
    """

    def __init__(self, port: PagePort, hold_port: int) -> None:
        self._port = port
        options = json.dumps({"port": hold_port, "speed": Controls.SPEED})
        ui.add_head_html(_HEAD.replace("OPTIONS", options))
        ui.dark_mode(None)
        with ui.element("main").classes("console"):
            # The controls are first in keyboard order; the style sheet positions them.
            self._controls = Controls(port)
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
        self._update_text()
        self._update_drawings()
        ui.timer(_TEXT_PERIOD, self._update_text)
        ui.timer(_DRAWING_PERIOD, self._update_drawings)

    def _update_text(self) -> None:
        snapshot = self._port.snapshot()
        self._controls.show(snapshot)
        self._status.show(snapshot)

    def _update_drawings(self) -> None:
        snapshot = self._port.snapshot()
        self._scene.show(snapshot)
        self._chart.set_content(chart(snapshot))


class StatusBar:
    """Strip above the pictures with states of device and controller, readings and warnings."""

    def __init__(self) -> None:
        with ui.element("section").classes("status").props('aria-label="State"'):
            self._kind = ui.label().classes("kind")
            self._device = _reading("Device")
            self._controller = _reading("Controller")
            self._dial = ui.html(dial(float("nan")), sanitize=False)
            self._readings = {name: _reading(name) for name in readings(Snapshot())}
            self._warnings = ui.label().classes("troubles").props('role="status"')

    def show(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        device, controller = snapshot.device, snapshot.controller
        self._kind.set_text("SIMULATED" if device is not None and device.simulated else "REAL RIG")
        self._kind.set_visibility(device is not None)
        self._device.set_text(_NO_STATUS if device is None else device.state)
        self._controller.set_text(_NO_STATUS if controller is None else controller.state)
        self._dial.set_content(dial(snapshot.rotation))
        for name, text in readings(snapshot).items():
            self._readings[name].set_text(text)
        self._warnings.set_text(" \N{MIDDLE DOT} ".join(f"! {text}" for text in snapshot.warnings))


def _reading(name: str) -> ui.label:
    with ui.element("div").classes("reading"):
        ui.label(name).classes("name")
        return ui.label().classes("value")
