"""The `operator` executable: the component `Operator` as a ROS node, with its input device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from needle_bringup.operator.component import INPUT_DEVICE, PERIOD, Operator
from needle_bringup.operator.event_source import Device, EventSource
from needle_bringup.operator.input_device import InputDevice
from needle_bringup.operator.parameters import JOY, OperatorParameters
from needle_core.component import Batch, PortChange, RealPort
from needle_core.ros.main import run_component

HELP = """\
operator: hold-to-run switch of the needle: a foot pedal, a key or a joystick.

Reads an event device (source pedal or joystick; parameters device and key), or a joystick from a
topic of type sensor_msgs/Joy (source joy) with 20 Hz or more. While the button is held, the needle
is inserted, or retracted with retract_key. It stops when the button is released, or when the device
is unplugged, silent or frozen. A button that is pressed at the start or after a loss is ignored
until all are released and it is pressed again. Before a retraction, a steering plane_controller is
stopped.

Publishes   device/hold
Subscribes  joy (source joy), device/status
Calls       device/stop, device/retract, plane_controller/stop
"""


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


def main(open_device: Callable[[str], Device] = InputDevice) -> int:
    """Run the operator; returns its exit code."""

    def ports(settings: OperatorParameters) -> Mapping[str, RealPort]:
        return {} if settings.source == JOY else {INPUT_DEVICE: InputPort(settings, open_device)}

    return run_component(
        "operator",
        OperatorParameters,
        Operator,
        help_text=HELP,
        ports=ports,
        shared_memory=False,
    )
