"""Controls of a page: buttons, hold, speed, stop and targets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import events, ui

from needle_console.hold.page_session import OWNER
from needle_console.page.page_port import PagePort
from needle_console.view.advice import Button, advise, usable_buttons
from needle_console.view.snapshot import Snapshot, stop_reason
from needle_console.view.targets import plane_pose, target_point
from needle_core.errors import UserError

_STEPS = (Button.CONFIRM, Button.HOME, Button.ENABLE, Button.START)
_OTHERS = (Button.RESET, Button.SWITCH_OFF)
_HOLDS = {Button.INSERT: "insert", Button.RETRACT: "retract"}
_RELEASE = "() => window.needleHold && window.needleHold.release()"
_SET_SPEED = "(value) => window.needleHold && window.needleHold.setSpeed(value / 100)"


class Controls:
    """Column of controls.

    Parameters
    ----------
    port : PagePort
        The port to the component.
    """

    SPEED = 0.5
    """Initial share of the nominal speed on a page."""

    def __init__(self, port: PagePort) -> None:
        self._port = port
        # A page may only watch until its hold is connected.
        self._watch_only_reason = "no hold: not connected"
        self._buttons: dict[Button, Any] = {}
        self._proposal = np.zeros(3)  # as shown [mm]
        with ui.element("section").classes("controls").props('aria-label="Controls"'):
            with ui.element("div").classes("advice").props('role="status" aria-live="polite"'):
                self._headline = ui.label().classes("headline")
                self._text = ui.label()
            with ui.element("div").classes("pairs"):
                for button in _STEPS:
                    self._add_button(button)
            self._build_hold(port)
            with ui.element("div").classes("pairs"):
                for button in _OTHERS:
                    self._add_button(button)
            self._answer = ui.label().classes("answer").props('role="status"')
            self._build_targets()
        ui.on("hold_bar", self._on_watch_only)

    def show(self, snapshot: Snapshot) -> None:
        """Show the next step, and enable the buttons that have an effect."""
        advice = advise(snapshot, OWNER)
        self._headline.set_text(advice.headline)
        self._text.set_text(advice.text)
        self._answer.set_text(snapshot.answer)
        if snapshot.proposed_point is not None:
            x, y, z = self._proposal = 1e3 * np.array(snapshot.proposed_point)
            self._propose.set_text(f"Set proposed point ({x:.1f}, {y:.1f}, {z:.1f}) mm")
        self._propose.set_visibility(snapshot.proposed_point is not None)
        possible = usable_buttons(snapshot)
        device = snapshot.device
        must_release = device is not None and device.press_again == OWNER
        why = stop_reason(device) if device is not None and must_release else ""
        self._not_counted.set_text(f"ignored by the device: {why}" if why else "")
        for button, element in self._buttons.items():
            usable = button in possible and not self._watch_only_reason
            if button not in _HOLDS:
                element.set_enabled(usable)
            # Hold buttons are never disabled, because one may be pressed at the moment.
            _mark(element, "dim", not usable)
            _mark(element, "again", must_release and button in _HOLDS)
            _mark(element, "next", button is advice.button and usable)

    def _build_hold(self, port: PagePort) -> None:
        for button, mode in _HOLDS.items():
            hold = ui.element("button").props(f'type="button" data-hold="{mode}"')
            hold.classes(f"hold {mode}")
            with hold:
                ui.label(button.value)
                if button is Button.INSERT:
                    self._not_counted = ui.label().classes("not-counted")
                    # page.js writes the status of the hold here.
                    ui.element("div").props('id="hold-words"')
            self._buttons[button] = hold
        # Grey, with a plain label, because it is not an emergency stop (docs/safety.md).
        stop = ui.button(
            Button.STOP.value, color="grey-7", on_click=lambda: port.press(Button.STOP)
        )
        stop.props('id="stop" no-caps unelevated').classes("stop")
        stop.on("click", js_handler=_RELEASE)
        with ui.element("div").classes("speed"):
            ui.label("Speed")
            slider = ui.slider(min=5, max=100, step=5, value=self.SPEED * 100)
            slider.props('aria-label="Speed in percent" label label-value="" dense')
            slider.on("update:model-value", js_handler=_SET_SPEED)
            ui.label().bind_text_from(slider, "value", lambda value: f"{value:.0f} %")

    def _build_targets(self) -> None:
        with ui.element("div").classes("targets"):
            offset = _number("Plane offset [mm]", 3.0)
            tilt = _number("Tilt [deg]", 0.0)
            self._add_target(
                "Set plane",
                lambda: self._port.send_plane(plane_pose(_typed(offset), _typed(tilt))),
            )
        with ui.element("div").classes("targets point"):
            x, y = _number("Point x [mm]", 10.0), _number("y [mm]", -5.0)
            z = _number("z [mm]", 100.0)
            self._add_target(
                "Set point",
                lambda: self._port.send_point(target_point(_typed(x), _typed(y), _typed(z))),
            )
        with ui.element("div").classes("targets"):
            self._propose = self._add_target(
                "", lambda: self._port.send_point(target_point(*self._proposal))
            ).style("grid-column: 1 / -1")

    def _add_button(self, button: Button) -> None:
        element = ui.button(button.value, color=None, on_click=lambda: self._press(button))
        self._buttons[button] = element.props("no-caps unelevated")

    def _add_target(self, name: str, send: Callable[[], None]) -> ui.button:
        def set_target() -> None:
            if self._watch_only_reason:
                ui.notify(self._watch_only_reason)
                return
            try:
                send()
            except UserError as error:
                ui.notify(str(error))

        button = ui.button(name, color=None, on_click=set_target)
        return button.props("no-caps unelevated")

    def _press(self, button: Button) -> None:
        if not self._watch_only_reason:
            self._port.press(button)

    def _on_watch_only(self, event: events.GenericEventArguments) -> None:
        self._watch_only_reason = str(event.args)


def _number(label: str, value: float) -> ui.number:
    return ui.number(label, value=value, step=0.5).props("dense outlined").classes("number")


def _typed(field: ui.number) -> float:
    """Return the number that was typed."""
    if field.value is None:
        raise UserError("a number is missing")
    return float(field.value)


def _mark(element: Any, name: str, present: bool) -> None:
    if present != (name in element.classes):
        element.classes(add=name) if present else element.classes(remove=name)
