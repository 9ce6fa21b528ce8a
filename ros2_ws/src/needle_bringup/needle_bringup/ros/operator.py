"""The `operator` executable: the component `Operator` as a ROS node, with its input device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from needle_bringup.operator.component import INPUT_DEVICE, Operator
from needle_bringup.operator.input_device import InputDevice
from needle_bringup.operator.input_port import InputPort
from needle_bringup.operator.parameters import JOY, OperatorParameters
from needle_core.component import RealPort
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
Subscribes  joy (source joy), device/status, needle/controller_status
Calls       device/stop, device/retract, plane_controller/stop
"""


def main(open_device: Callable[[str], Any] = InputDevice) -> int:
    """Run the operator; return its exit code."""

    def ports(settings: OperatorParameters) -> Mapping[str, RealPort]:
        return {} if settings.source == JOY else {INPUT_DEVICE: InputPort(settings, open_device)}

    return run_component(
        "operator", OperatorParameters, Operator, help_text=HELP, ports=ports, shared_memory=False
    )
