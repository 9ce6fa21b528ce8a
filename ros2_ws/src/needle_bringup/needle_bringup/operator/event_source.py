"""A pedal, key or joystick as an input device of the kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from needle_bringup.operator.controls import Controls, InputLost, InputReading, InputState
from needle_bringup.operator.input_device import EventReader, KeyChanges

# Time between two attempts to open the device [s].
OPEN_PERIOD = 0.5


class Device(Protocol):
    """The part of `InputDevice` that a source uses."""

    keys: frozenset[int]

    def read(self) -> bytes:
        """Return the queued events."""

    def keys_down(self) -> frozenset[int]:
        """Return the keys that are down."""

    def axis(self, code: int) -> float:
        """Return the position of an axis, -1..1."""

    def close(self) -> None:
        """Close the device."""


class EventSource:
    """Reads the controls from a device that is polled.

    A pedal that is held down sends no events, so the state of its key is queried. The events show
    changes between two readings.

    Parameters
    ----------
    path : str
        The device file.
    controls : Controls
        Meaning of its keys and axes.
    speed : callable
        Returns the speed at full axis, or without an axis, 0..1.
    open_device : callable
        Opens the device file.
    """

    def __init__(
        self,
        path: str,
        controls: Controls,
        speed: Callable[[], float],
        open_device: Callable[[str], Device],
    ) -> None:
        self._path = path
        self._controls = controls
        self._speed = speed
        self._open_device = open_device
        self._device: Device | None = None
        self._events = EventReader()
        self._reason = ""
        self._next_try: float | None = None

    def read(self, now: float) -> InputReading:
        """Return the state of the controls at this steady time [s]."""
        if self._device is None and self._next_try is not None and now < self._next_try:
            return InputLost(self._reason)
        try:
            if self._device is None:
                self._open(now)
            return self._poll()
        except OSError as error:
            self._close()
            self._next_try = now + OPEN_PERIOD
            self._reason = f"{self._path}: {error.strerror}"
            return InputLost(self._reason)

    def _open(self, now: float) -> None:
        self._next_try = now + OPEN_PERIOD
        self._device = self._open_device(self._path)
        self._events = EventReader()
        missing = [key for key in self._controls.buttons if key not in self._device.keys]
        if missing:
            present = ", ".join(map(str, sorted(self._device.keys))) or "none"
            raise OSError(0, f"it has no key {missing[0]} (its keys: {present})")

    def _close(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _poll(self) -> InputState:
        assert self._device is not None
        # Events first: a later change shows in the state of the keys, and in the next reading.
        changes = self._events.decode(self._device.read())
        down = self._device.keys_down()
        controls, speed = self._controls, self._speed()
        if controls.speed_axis is not None:
            speed *= controls.speed(self._device.axis(controls.speed_axis))
        return InputState(
            insert=_is_held(controls.insert, down, changes),
            retract=_is_held(controls.retract, down, changes),
            stop=controls.stop in down or controls.stop in changes.pressed,
            speed=speed,
        )


def _is_held(key: int | None, down: frozenset[int], changes: KeyChanges) -> bool:
    """Return whether a key is down, and has been down since the last reading."""
    return key in down and key not in changes.released and not changes.dropped
