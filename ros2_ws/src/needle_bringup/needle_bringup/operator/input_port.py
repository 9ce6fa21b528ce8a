"""Port of the operator on an input device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from needle_bringup.operator.component import PERIOD
from needle_bringup.operator.event_source import Device, EventSource
from needle_bringup.operator.input_device import InputDevice
from needle_bringup.operator.parameters import OperatorParameters
from needle_core.component import Batch, PortChange


class InputPort:
    """The input device: read every `PERIOD`, when the component handles the event.

    Parameters
    ----------
    settings : OperatorParameters
        The device, and the meaning of its keys.
    open_device : callable
        Opens it.
    """

    def __init__(
        self, settings: OperatorParameters, open_device: Callable[[str], Device] = InputDevice
    ) -> None:
        self._speed = settings.speed_scale
        self._source = EventSource(
            settings.device, settings.controls, lambda: self._speed, open_device
        )
        self._closed = threading.Event()

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Start the periodic readings."""
        threading.Thread(target=self._request_readings, args=(arrive,), daemon=True).start()

    def send(self, batch: tuple[float, ...]) -> None:
        """Set the speed at full axis, or without an axis, 0..1."""
        self._speed = batch[-1]

    def close(self) -> None:
        """Stop the readings."""
        self._closed.set()

    def _request_readings(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        while not self._closed.wait(PERIOD):
            arrive(lambda: (self._source.read(time.monotonic()),))
