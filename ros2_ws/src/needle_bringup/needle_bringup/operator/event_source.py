"""A pedal, key or joystick that the kernel knows as an input device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from needle_bringup.operator.controls import Controls
from needle_bringup.operator.hand import Hand, Lost, Reading
from needle_bringup.operator.input_events import EventReader, KeyChanges

# How long to wait before a device that is not there is looked for again [s].
OPEN_PERIOD = 0.5


class Device(Protocol):
    """The part of `InputDevice` that a source needs."""

    keys: frozenset[int]

    def read(self) -> bytes:
        """Return the events that wait."""

    def keys_down(self) -> frozenset[int]:
        """Return the keys that are down."""

    def axis(self, code: int) -> float:
        """Return where an axis is, -1..1."""

    def close(self) -> None:
        """Let go of it."""


class EventSource:
    """Tells what the hand does by a device that is asked again at each look.

    A pedal that is held down sends nothing: what counts is that its device is still there and says
    that the key is down. Its events tell what happened between two looks.

    Parameters
    ----------
    path : str
        The device file.
    controls : Controls
        What its keys and axes mean.
    speed : callable
        Returns the speed at the axis' full end, or without an axis, 0..1.
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
        self._why = ""
        self._next_try: float | None = None

    def read(self, now: float) -> Reading:
        """Return what the hand does at this time of the steady clock [s]."""
        if self._device is None and self._next_try is not None and now < self._next_try:
            return Lost(self._why)
        try:
            if self._device is None:
                self._open(now)
            return self._look()
        except OSError as error:
            self._let_go()
            self._next_try = now + OPEN_PERIOD
            self._why = f"{self._path}: {error.strerror}"
            return Lost(self._why)

    def _open(self, now: float) -> None:
        self._next_try = now + OPEN_PERIOD
        self._device = self._open_device(self._path)
        self._events = EventReader()
        missing = [key for key in self._controls.buttons if key not in self._device.keys]
        if missing:
            there = ", ".join(map(str, sorted(self._device.keys))) or "none"
            raise OSError(0, f"it has no key {missing[0]} (its keys: {there})")

    def _let_go(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.close()

    def _look(self) -> Hand:
        assert self._device is not None
        # The events first: what comes after them shows in the state of the keys, and next time.
        changes = self._events.take(self._device.read())
        down = self._device.keys_down()
        controls, speed = self._controls, self._speed()
        if controls.speed_axis is not None:
            speed *= controls.speed(self._device.axis(controls.speed_axis))
        return Hand(
            insert=_is_held(controls.insert, down, changes),
            retract=_is_held(controls.retract, down, changes),
            stop=controls.stop in down or controls.stop in changes.pressed,
            speed=speed,
        )


def _is_held(key: int | None, down: frozenset[int], changes: KeyChanges) -> bool:
    """Return whether a key is down, and was all the time since the last look."""
    return key in down and key not in changes.released and not changes.dropped
