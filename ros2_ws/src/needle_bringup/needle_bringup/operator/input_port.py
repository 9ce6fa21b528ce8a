"""Port between the operator and an input device of the kernel: a pedal, key or joystick."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from needle_bringup.operator.hold_debouncer import InputLost, InputReading, InputState
from needle_bringup.operator.input_device import InputDevice, key_changes
from needle_bringup.operator.parameters import NONE, PERIOD, OperatorParameters
from needle_core.component import Batch, PortChange

# Time between two attempts to open the device [s].
OPEN_PERIOD = 0.5


class InputPort:
    """Port that reads the input device every `PERIOD`, when the component handles the event.

    A pedal that is held down sends no events, so the state of its key is queried. The events reveal
    changes between two readings.

    Parameters
    ----------
    settings : OperatorParameters
        The device, and the assignment of its keys and axes.
    open_device : callable
        Opens the device file; returns an object with the methods of `InputDevice`.
    """

    def __init__(
        self, settings: OperatorParameters, open_device: Callable[[str], Any] = InputDevice
    ) -> None:
        self._settings, self._open_device = settings, open_device
        self._speed = settings.speed_scale
        self._device: InputDevice | None = None
        self._lost = InputLost("")
        self._next_try: float | None = None
        self._closed = threading.Event()

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Start the periodic readings."""
        threading.Thread(target=self._request_readings, args=(arrive,), daemon=True).start()

    def send(self, batch: tuple[float, ...]) -> None:
        """Set the speed at full deflection of the axis, or without an axis, 0..1."""
        self._speed = batch[-1]

    def close(self) -> None:
        """Stop the readings."""
        self._closed.set()

    def _request_readings(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        while not self._closed.wait(PERIOD):
            arrive(lambda: (self.read(time.monotonic()),))

    def read(self, now: float) -> InputReading:
        """Return the state of the controls at this steady time [s]."""
        if self._device is None and self._next_try is not None and now < self._next_try:
            return self._lost
        try:
            if self._device is None:
                self._next_try = now + OPEN_PERIOD
                self._device = self._open_device(self._settings.device)
                self._check_keys(self._device)
            return self._poll(self._device)
        except OSError as error:
            device, self._device = self._device, None
            if device is not None:
                device.close()
            self._next_try = now + OPEN_PERIOD
            self._lost = InputLost(f"{self._settings.device}: {error.strerror}")
            return self._lost

    def _check_keys(self, device: InputDevice) -> None:
        missing = [key for key in self._settings.keys if key not in device.keys]
        if missing:
            present = ", ".join(map(str, sorted(device.keys))) or "none"
            raise OSError(0, f"it has no key {missing[0]} (its keys: {present})")

    def _poll(self, device: InputDevice) -> InputState:
        # Read the events first: later changes affect the key states, and the next reading.
        changes = key_changes(device.read())
        down, settings, speed = device.keys_down(), self._settings, self._speed
        if settings.speed_axis != NONE:
            speed *= settings.speed(device.axis(settings.speed_axis))
        # A key counts as held only if it was not released since the last reading.
        held = frozenset() if changes.dropped else down - changes.released
        return InputState(
            insert=settings.key in held,
            retract=settings.retract_key in held,
            stop=settings.stop_key in down | changes.pressed,
            speed=speed,
        )
