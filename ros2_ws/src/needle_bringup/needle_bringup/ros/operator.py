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
operator: holds the needle's switch for a person: a foot pedal, a key, a joystick.

A pedal, key or joystick by its event device (source pedal or joystick, device, key), or a
joystick behind a topic of sensor_msgs/Joy (source joy), which must talk at 20 Hz or more. Held, the
needle is inserted, or drawn out with retract_key; released, unplugged, silent or frozen it stops.
What is held at the start or after a loss counts only when all was let go of and it is pressed
again. To draw the needle out, a plane_controller that steers is stopped first.

Publishes   device/hold
Subscribes  joy (source joy), device/status
Calls       device/stop, device/retract, plane_controller/stop
"""


class InputPort:
    """The input device: looked at every `PERIOD`, at the moment when the look is handled.

    Parameters
    ----------
    settings : OperatorParameters
        Which device, and what its keys mean.
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
        """Begin to ask for a look."""
        threading.Thread(target=self._ask, args=(arrive,), daemon=True).start()

    def send(self, batch: tuple[float, ...]) -> None:
        """Take the speed at the axis' full end, or without an axis, 0..1."""
        self._speed = batch[-1]

    def close(self) -> None:
        """Ask no more."""
        self._closed.set()

    def _ask(self, arrive: Callable[[Batch | PortChange], None]) -> None:
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
