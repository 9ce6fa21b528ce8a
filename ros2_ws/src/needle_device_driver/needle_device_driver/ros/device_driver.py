"""The `device_driver` executable: the `device/...` interface on real drives."""

from __future__ import annotations

import logging
import sys
import time

from needle_core.process.discovery import DISCOVERY, is_network_enabled
from needle_core.ros.main import run_component
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters, DriverParameters

HELP = """\
device_driver: moves the insertion stepper and the rotation servo, CiA 402 drives on a CAN bus.

Publishes   joint_states (50 Hz), device/status, device/result
Subscribes  device/joint_trajectory, device/hold, device/estop
Services    device/{home,retract,stop,reset}, device/{enable,confirm_needle_out}

The node waits for adapter and drives (`connect_timeout`); nothing moves at start. To move the
needle, call device/confirm_needle_out with true, device/home and device/enable with true, then hold
the switch and send steps. Ctrl-C stops both axes and disables the drives.

docs/hardware.md: wiring, adapters, commissioning of drives
docs/safety.md:   all rules that stop or reject a motion

Exit codes: 0 ended by a signal; 2 the adapter or a drive is missing, or a parameter is invalid
"""

# Longer than a node takes to discover its peers on the same machine [s].
_LOCAL_DISCOVERY = 0.3


def make_driver(settings: DriverParameters, name: str) -> DeviceDriver:
    """Return the driver, which searches for the drives after the discovery of other devices."""
    discovery = DISCOVERY if is_network_enabled() else _LOCAL_DISCOVERY
    return DeviceDriver(settings, name, search_from=time.monotonic() + discovery)


def main() -> int:
    """Run device_driver; returns its exit code."""
    # python-can errors are reported as axis faults.
    logging.getLogger("can").addHandler(logging.NullHandler())
    return run_component(
        "device_driver",
        DeviceDriverParameters,
        make_driver,
        help_text=HELP,
        ports=lambda settings: settings.ports(),
        shared_memory=False,
    )


if __name__ == "__main__":
    sys.exit(main())
