"""Scenes for the rules that the conformance kit leaves out, each with the name of its rule."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

from needle_core import messages as m
from needle_core.component import Call, Publish
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.conformance.rig import AXES, HandState
from needle_device_driver.rules import Rule
from scenario.virtual_rig import COMMANDS, HOLD, STATUS, VirtualRig

# Length [m], rotation [rad] and duration [s] of steps that are rejected after a valid one.
_REFUSED_STEPS: Mapping[Rule, tuple[float, float, float]] = {
    Rule.COMMAND_FORM: (0.001, 0.0, 0.0),
    Rule.COMMAND_FINITE: (math.nan, 0.0, 1.0),
    Rule.FORWARD_ONLY: (-0.001, 1.0, 1.0),
    Rule.MAX_DEPTH: (0.0015, 0.0, 1.0),
    Rule.MAX_STEP_LENGTH: (0.0021, 1.0, 1.0),
    Rule.MAX_SPEED: (0.002, 0.0, 0.39),
    Rule.MAX_ROTATION_STEP: (0.002, 1.21, 1.0),
    Rule.MAX_ROTATION_RATE: (0.001, 1.1, 0.34),
    Rule.MAX_TURNS: (0.002, 1.0, 1.0),
}
_LIMITS = {Rule.MAX_DEPTH: {"max_depth": 0.003}, Rule.MAX_TURNS: {"max_turns": 0.25}}
"""Parameters of the driver with which the step is beyond a limit."""
# Objects with the units of a drive's speeds.
UNITS = {0x608F, 0x60A8, 0x60A9, 0x60AA}
DEEP = 0.1


def hold_new_press() -> None:
    """A press from before the axes were enabled moves nothing."""
    scene = VirtualRig(1)
    scene.home()
    scene.hand.state = HandState(True)
    scene.runner.run(0.1)
    scene.call("device/enable", False)
    scene.call("device/enable", True)
    scene.step()
    assert scene.refuses(Rule.HOLD_NEW_PRESS)


def hold_one_owner() -> None:
    """A second press does not count during the first, nor after its release."""
    scene = VirtualRig(1)
    scene.ready()
    other = scene.start_node(HOLD)
    for count, pressed in enumerate((False, True), 1):
        scene.act(other, Publish(HOLD.topic, m.HoldState("other", "", count, pressed, 1.0, 0.1)))
    assert scene.is_logged(Rule.HOLD_ONE_OWNER)
    assert scene.hand.status.hold_owner == "hand"


def hold_in_order() -> None:
    """A repeated old press does not count."""
    scene = VirtualRig(1)
    scene.ready()
    other = scene.start_node(HOLD)
    old = m.HoldState(scene.hand.name, scene.hand.session._session, 1, False, 0.0, 0.1)
    scene.act(other, Publish(HOLD.topic, old))
    assert scene.is_logged(Rule.HOLD_IN_ORDER)
    assert scene.hand.status.holds_ignored > 0
    assert scene.hand.status.hold_owner == "hand"


def speed_scale() -> None:
    """A speed scale that is not a number is a release."""
    scene = VirtualRig(1)
    scene.moving()
    scene.hand.state = HandState(True, math.nan)
    scene.runner.run(0.1)
    assert scene.is_at_rest()
    assert scene.hand.status.hold_owner == ""


def one_device() -> None:
    """Nothing moves while another device publishes its status."""
    scene = VirtualRig(1)
    scene.moving()
    scene.start_node(STATUS)
    assert scene.fails(Rule.ONE_DEVICE)


def command_state() -> None:
    """A second command does not end the running step."""
    scene = VirtualRig(1)
    first = scene.moving()
    second = scene.step(0.001, 0.1, 0.5)
    assert scene.is_logged(Rule.COMMAND_STATE)
    scene.until(lambda: first in scene.hand.results, "the first step")
    assert scene.hand.results[first] == "succeeded"
    assert scene.hand.results[second].startswith("aborted")


def command_one_publisher() -> None:
    """Commands of two publishers are rejected."""
    scene = VirtualRig(1)
    scene.ready()
    scene.start_node(COMMANDS)
    scene.step()
    assert scene.refuses(Rule.COMMAND_ONE_PUBLISHER)


def command_newer() -> None:
    """A command that arrives twice is executed once."""
    scene = VirtualRig(1)
    scene.ready()
    stamp = scene.step()
    scene.until_done(stamp)
    scene.send(0.004, stamp)
    assert scene.refuses(Rule.COMMAND_NEWER)


def tip_age() -> None:
    """A command for a tip of 2.1 s ago is rejected."""
    scene = VirtualRig(1)
    scene.ready()
    scene.runner.run(3.0)
    scene.send(0.001, scene.runner.timeline.stamp_ns - 2_100_000_000)
    assert scene.refuses(Rule.TIP_AGE)


def homed_first() -> None:
    """No step begins before homing."""
    scene = VirtualRig(1)
    scene.until(lambda: scene.state == "DISABLED", "the driver")
    scene.call("device/enable", True)
    scene.press()
    scene.step(0.001, 0.0, 0.5)
    assert scene.refuses(Rule.HOMED_FIRST)


def coordinated() -> None:
    """Rotation follows insertion in proportion, also while the speed scale changes."""
    scene = VirtualRig(1)
    scene.ready()
    positions = [scene.positions]
    stamp = scene.step()
    while stamp not in scene.hand.results:
        scene.hand.state = HandState(True, 1.0 if len(positions) < 10 else 0.3)
        scene.runner.run(PERIOD)
        positions.append(scene.positions)
    begin, end = positions[0], positions[-1]
    for at in positions:
        insertion, rotation = (
            (now - first) / (last - first) for now, first, last in zip(at, begin, end, strict=True)
        )
        assert abs(insertion - rotation) < 0.005


def homing_needle_out() -> None:
    """Homing needs the confirmation that the needle is out."""
    scene = VirtualRig(1)
    scene.until(lambda: scene.state == "DISABLED", "the driver")
    scene.hand.answers.clear()
    scene.hand.actions.append(Call("device/home"))
    assert scene.is_at_rest(1.0)
    assert [answer.success for answer in scene.hand.answers] == [False]


def axis_speed() -> None:
    """A drive with another unit of speed is stopped within 8 mm."""
    scene = VirtualRig(
        1, drives={"rpm": True, "insertion_start": DEEP, "insertion_max_speed": 0.15}
    )
    for drive in scene.drives.bus.drives.values():
        for key in [key for key in drive._objects._entries if key[0] in UNITS]:
            del drive._objects._entries[key]
    scene.begin_homing()
    scene.runner.run(1.0)
    assert scene.fails(Rule.AXIS_SPEED)
    assert DEEP - scene.positions[0] < 0.008


def software_limits() -> None:
    """The drive itself enforces the limits of travel."""
    scene = VirtualRig(1)
    scene.home()
    for axis in AXES:
        objects = scene.drives.bus.drives[axis]._objects
        lower, upper = (
            int.from_bytes(objects.read(0x607D, sub), "little", signed=True) for sub in (1, 2)
        )
        assert -(2**31) < lower < 0 < upper < 2**31 - 1


def drive_reboot() -> None:
    """A reboot of a drive is a fault, and named."""
    scene = VirtualRig(1, drives={"boot_time": 0.05})
    scene.ready()
    scene.drives.bus.reboot("rotation", scene.runner.now)
    scene.runner.run(1.0)
    assert scene.fails(Rule.DRIVE_REBOOT)


def _refuse_step(rule: Rule) -> None:
    """Check that the step of `_REFUSED_STEPS` is rejected by its rule."""
    scene = VirtualRig(1, driver=_LIMITS.get(rule))
    scene.ready()
    scene.until_done(scene.step())
    scene.step(*_REFUSED_STEPS[rule])
    assert scene.refuses(rule)


SCENES: Mapping[str, Callable[[], None]] = {
    **{
        scene.__name__: scene
        for scene in (
            *(hold_new_press, hold_one_owner, hold_in_order, speed_scale, one_device),
            *(command_state, command_one_publisher, command_newer, tip_age, homed_first),
            *(coordinated, homing_needle_out, axis_speed, software_limits, drive_reboot),
        )
    },
    **{rule.value: partial(_refuse_step, rule) for rule in _REFUSED_STEPS},
}
