"""Scenes for the rules of axes, drives and bus, each with the name of its rule."""

from __future__ import annotations

from needle_device_driver.conformance.rig import AXES
from needle_device_driver.rules import Rule
from scenario.virtual_rig import VirtualRig

# Objects with the units of a drive's speeds.
UNITS = {0x608F, 0x60A8, 0x60A9, 0x60AA}
DEEP = 0.1


def axis_speed() -> None:
    """A drive with another unit of speed is stopped within 8 mm."""
    scene = VirtualRig(
        1, drives={"rpm": True, "insertion_start": DEEP, "insertion_max_speed": 0.15}
    )
    for drive in scene.bus.drives.values():
        for key in [key for key in drive._objects._entries if key[0] in UNITS]:
            del drive._objects._entries[key]
        drive._objects._indices.difference_update(UNITS)
    scene.begin_homing()
    scene.runner.run(1.0)
    assert scene.fails(Rule.AXIS_SPEED)
    assert DEEP - scene.place[0] < 0.008


def software_limits() -> None:
    """The drive itself enforces the limits of travel."""
    scene = VirtualRig(1)
    scene.home()
    for axis in AXES:
        objects = scene.bus.drives[axis]._objects
        lower, upper = (
            int.from_bytes(objects.read(0x607D, sub), "little", signed=True) for sub in (1, 2)
        )
        assert -(2**31) < lower < 0 < upper < 2**31 - 1


def drive_reboot() -> None:
    """A reboot of a drive is a fault, and named."""
    scene = VirtualRig(1, drives={"boot_time": 0.05})
    scene.ready()
    scene.bus.reboot("rotation", scene.runner.now)
    scene.runner.run(1.0)
    assert scene.fails(Rule.DRIVE_REBOOT)


SCENES = (axis_speed, software_limits, drive_reboot)
