"""Scenes for the rules of axes, drives and bus, each with the name of its rule."""

from __future__ import annotations

import dataclasses

from needle_core import messages as m
from needle_core.can_frame import CAN, CanFrame
from needle_core.component import Publish
from needle_device_driver.rules import Rule
from needle_sim.drives.cia402 import PowerState
from scenario.rules.scene import AXES, DRIVER, ESTOP, Scene

ON = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)
SYNC = 0x080
# Objects with the units of a drive's speeds.
UNITS = {0x608F, 0x60A8, 0x60A9, 0x60AA}
DEEP = 0.1


def states(scene: Scene) -> list[PowerState]:
    """Return both drives' states."""
    return [scene.bus.drives[axis].state for axis in AXES]


def following_error() -> None:
    """A following error of one axis stops both."""
    scene = Scene()
    scene.moving()
    scene.bus.stall("insertion")
    scene.runner.run(1.0)
    assert scene.fails(Rule.FOLLOWING_ERROR)


def unhomed_outward_only() -> None:
    """After a drive's reboot the needle moves outwards only, by its last insertion."""
    scene = Scene()
    scene.ready()
    scene.until_done(scene.step())
    scene.bus.reboot("insertion", scene.runner.now)
    scene.runner.run(1.0)
    scene.release()
    scene.call("device/reset")
    scene.call("device/enable", True)
    scene.press()
    scene.send(((0.003, 0.0), 1.0))
    assert scene.refuses(Rule.HOMED_FIRST)
    deep = scene.place[0]
    scene.call("device/retract")
    scene.until(lambda: scene.hand.status.activity == "none", "the retraction")
    assert -1e-4 < scene.place[0] < 0.1 * deep


def homing_time() -> None:
    """A homing that takes too long is stopped."""
    scene = Scene({"max_depth": 0.02}, drives={"insertion_start": DEEP})
    scene.until(lambda: scene.state == "DISABLED", "the driver")
    scene.call("device/confirm_needle_out", True)
    scene.call("device/home")
    scene.until(lambda: scene.state == "FAULT", "the end of a homing")
    assert DEEP - scene.place[0] < 1.25 * 0.02
    assert scene.fails(Rule.HOMING_TIME)


def estop_latches() -> None:
    """An emergency stop ends the motion; releasing it moves nothing."""
    scene = Scene()
    scene.moving()
    other = scene.start_node(ESTOP)
    scene.act(other, Publish(ESTOP.topic, m.EmergencyStop(True)))
    assert scene.is_at_rest()
    assert scene.is_logged(Rule.ESTOP_LATCHES)
    scene.act(other, Publish(ESTOP.topic, m.EmergencyStop(False)))
    assert scene.is_at_rest()
    assert scene.state == "ESTOPPED"


def one_fault_stops_both() -> None:
    """The fault of one drive also switches off the other."""
    scene = Scene()
    scene.moving()
    scene.bus.fail("insertion", 0x2310)
    scene.runner.run(0.5)
    assert scene.state == "FAULT"
    assert not set(states(scene)) & set(ON)


def inner_limit_switch() -> None:
    """A step ends at the inner limit switch."""
    scene = Scene({"max_depth": 0.3})
    scene.ready()
    motor = scene.bus.drives["insertion"].motor
    scene.until_done(scene.step(0.0005, 0.0))
    motor._settings = dataclasses.replace(motor._settings, travel=motor.position + 10_000.0)
    scene.step()
    scene.runner.run(1.0)
    assert scene.fails(Rule.INNER_LIMIT_SWITCH)


def reply_age() -> None:
    """A silent drive is a fault."""
    scene = Scene()
    scene.moving()
    scene.bus.hang("rotation")
    assert scene.fails(Rule.REPLY_AGE)


def axis_speed() -> None:
    """A drive with another unit of speed is stopped within 8 mm."""
    scene = Scene(drives={"rpm": True, "insertion_start": DEEP, "insertion_max_speed": 0.15})
    for drive in scene.bus.drives.values():
        for key in [key for key in drive._objects._entries if key[0] in UNITS]:
            del drive._objects._entries[key]
        drive._objects._indices.difference_update(UNITS)
    scene.until(lambda: scene.state == "DISABLED", "the driver")
    scene.call("device/confirm_needle_out", True)
    scene.call("device/home")
    scene.runner.run(1.0)
    assert scene.fails(Rule.AXIS_SPEED)
    assert DEEP - scene.place[0] < 0.008


def settling_time() -> None:
    """A step that does not reach its target is a fault."""
    scene = Scene()
    scene.moving()
    scene.until(lambda: scene.place[0] > 0.0018, "the step's end")
    scene.bus.stall("insertion")
    scene.runner.run(1.5)
    assert scene.fails(Rule.SETTLING_TIME)


def link_loss() -> None:
    """An unplugged adapter is logged."""
    scene = Scene()
    scene.moving()
    scene.runner.lose_port(DRIVER, CAN, "unplugged")
    assert scene.fails(Rule.LINK_LOSS)


def one_master() -> None:
    """A SYNC of another master is a fault."""
    scene = Scene()
    scene.moving()
    scene.extra_frames = [CanFrame(SYNC)]
    assert scene.fails(Rule.ONE_MASTER)


def drive_watchdog() -> None:
    """Drives without a driver stop, and report a fault."""
    scene = Scene()
    scene.moving()
    scene.runner.freeze(DRIVER, 1.0)
    scene.runner.run(0.5)
    assert states(scene) == [PowerState.FAULT] * 2
    scene.runner.run(0.7)
    assert scene.fails(Rule.DRIVE_WATCHDOG)


def drive_emergency() -> None:
    """A drive's emergency message stops both."""
    scene = Scene()
    scene.moving()
    scene.bus.fail("rotation", 0x4210)
    assert scene.fails(Rule.DRIVE_EMERGENCY)


def drive_reboot() -> None:
    """A reboot of a drive is a fault."""
    scene = Scene(drives={"boot_time": 0.05})
    scene.ready()
    scene.bus.reboot("rotation", scene.runner.now)
    scene.runner.run(1.0)
    assert scene.fails(Rule.DRIVE_REBOOT)
    assert not scene.hand.status.homed


def quick_stop() -> None:
    """A release stops the drives at once, before their next set-point."""
    scene = Scene()
    scene.moving()
    scene.release()
    assert states(scene) == [PowerState.QUICK_STOP_ACTIVE] * 2
    assert scene.is_at_rest()


def software_limits() -> None:
    """The drive itself enforces the limits of travel."""
    scene = Scene()
    scene.home()
    for axis in AXES:
        objects = scene.bus.drives[axis]._objects
        lower, upper = (
            int.from_bytes(objects.read(0x607D, sub), "little", signed=True) for sub in (1, 2)
        )
        assert -(2**31) < lower < 0 < upper < 2**31 - 1


def look_ahead() -> None:
    """After a kill of the driver, the needle moves by at most 0.1 mm."""
    scene = Scene()
    scene.ready()
    scene.step(duration=0.41)
    scene.until(lambda: scene.place[0] > 0.0005, "a step under way")
    assert scene.state == "MOVING"
    scene.runner.kill(DRIVER)
    begin = scene.place[0]
    scene.runner.run(0.5)
    assert scene.place[0] - begin < 0.00021


def loop_heartbeat() -> None:
    """Each cycle sends a heartbeat, and drives at rest report no fault."""
    scene = Scene()
    scene.ready()
    before = scene.heartbeats
    scene.runner.run(1.0)
    assert 49 <= scene.heartbeats - before <= 51
    assert scene.state == "HOLDING"


SCENES = (
    following_error, unhomed_outward_only, homing_time, estop_latches, one_fault_stops_both,
    inner_limit_switch, reply_age, axis_speed, settling_time, link_loss, one_master, drive_watchdog,
    drive_emergency, drive_reboot, quick_stop, software_limits, look_ahead, loop_heartbeat,
)  # fmt: skip
