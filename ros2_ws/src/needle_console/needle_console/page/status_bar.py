"""The strip above the pictures: states, readings, troubles."""

from __future__ import annotations

from nicegui import ui

from needle_console.view.dial import dial
from needle_console.view.readings import readings
from needle_console.view.snapshot import Snapshot

_NOT_HEARD = "not heard"


class StatusBar:
    """States of device and controller, figures, and what nodes warn of."""

    def __init__(self) -> None:
        with ui.element("section").classes("status").props('aria-label="State"'):
            self._kind = ui.label().classes("kind")
            self._device = _reading("Device")
            self._controller = _reading("Controller")
            self._dial = ui.html(dial(float("nan")), sanitize=False)
            self._readings = {name: _reading(name) for name in readings(Snapshot())}
            self._troubles = ui.label().classes("troubles").props('role="status"')

    def show(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        device, controller = snapshot.device, snapshot.controller
        self._kind.set_text("SIMULATED" if device is not None and device.simulated else "REAL RIG")
        self._kind.set_visibility(device is not None)
        self._device.set_text(_NOT_HEARD if device is None else device.state)
        self._controller.set_text(_NOT_HEARD if controller is None else controller.state)
        self._dial.set_content(dial(snapshot.rotation))
        for name, text in readings(snapshot).items():
            self._readings[name].set_text(text)
        self._troubles.set_text(" \N{MIDDLE DOT} ".join(f"! {text}" for text in snapshot.troubles))


def _reading(name: str) -> ui.label:
    with ui.element("div").classes("reading"):
        ui.label(name).classes("name")
        return ui.label().classes("value")
