"""Scenes for the rules of holds and commands, each with the name of its rule."""

from __future__ import annotations

import math

from needle_core import messages as m
from needle_core.component import Call, Publish
from needle_device_driver.rules import Rule
from scenario.rules.scene import COMMANDS, HOLD, STATUS, Held, Scene


def hold_new_press() -> None:
    """A press from before the axes were enabled moves nothing."""
    scene = Scene()
    scene.home()
    scene.hand.held = Held(True)
    scene.runner.run(0.1)
    scene.call("device/enable", False)
    scene.call("device/enable", True)
    scene.step()
    assert scene.refuses(Rule.HOLD_NEW_PRESS)


def hold_one_owner() -> None:
    """A second press does not count during the first, nor after its release."""
    scene = Scene()
    scene.ready()
    other = scene.start_node(HOLD)
    for count, pressed in enumerate((False, True), 1):
        scene.act(other, Publish(HOLD.topic, m.HoldState("other", "", count, pressed, 1.0, 0.1)))
    assert scene.is_logged(Rule.HOLD_ONE_OWNER)
    assert scene.hand.status.hold_owner == "hand"


def hold_in_order() -> None:
    """A repeated old press does not count."""
    scene = Scene()
    scene.ready()
    other = scene.start_node(HOLD)
    old = m.HoldState(scene.hand.name, scene.hand.session._session, 1, False, 0.0, 0.1)
    scene.act(other, Publish(HOLD.topic, old))
    assert scene.is_logged(Rule.HOLD_IN_ORDER)
    assert scene.hand.status.holds_ignored > 0
    assert scene.hand.status.hold_owner == "hand"


def speed_scale() -> None:
    """A speed scale that is not a number is a release."""
    scene = Scene()
    scene.moving()
    scene.hand.held = Held(True, math.nan)
    scene.runner.run(0.1)
    assert scene.is_at_rest()
    assert scene.hand.status.hold_owner == ""


def one_device() -> None:
    """Nothing moves while another device publishes its status."""
    scene = Scene()
    scene.moving()
    scene.start_node(STATUS)
    assert scene.fails(Rule.ONE_DEVICE)


def command_state() -> None:
    """A second command does not end the running step."""
    scene = Scene()
    first = scene.moving()
    second = scene.step(0.001, 0.1, 0.5)
    assert scene.is_logged(Rule.COMMAND_STATE)
    scene.until(lambda: first in scene.hand.results, "the first step")
    assert scene.hand.results[first] == "succeeded"
    assert scene.hand.results[second].startswith("aborted")


def command_one_publisher() -> None:
    """Commands of two publishers are rejected."""
    scene = Scene()
    scene.ready()
    scene.start_node(COMMANDS)
    scene.step()
    assert scene.refuses(Rule.COMMAND_ONE_PUBLISHER)


def command_form() -> None:
    """A command without a time is rejected."""
    scene = Scene()
    scene.ready()
    scene.send(((0.001, 0.0), 0.0))
    assert scene.refuses(Rule.COMMAND_FORM)


def command_finite() -> None:
    """A command that is not a number is rejected."""
    scene = Scene()
    scene.ready()
    scene.send(((math.nan, 0.0), 1.0))
    assert scene.refuses(Rule.COMMAND_FINITE)


def command_newer() -> None:
    """A command that arrives twice is executed once."""
    scene = Scene()
    scene.ready()
    stamp = scene.send(((0.001, 0.0), 0.5))
    scene.until(lambda: stamp in scene.hand.results, "the step")
    scene.send(((0.002, 0.0), 0.5), stamp=stamp)
    assert scene.refuses(Rule.COMMAND_NEWER)


def tip_age() -> None:
    """A command for a tip of 2.1 s ago is rejected."""
    scene = Scene()
    scene.ready()
    scene.runner.run(3.0)
    scene.send(((0.001, 0.0), 0.5), age=2.1)
    assert scene.refuses(Rule.TIP_AGE)


def homed_first() -> None:
    """No step begins before homing."""
    scene = Scene()
    scene.until(lambda: scene.state == "DISABLED", "the driver")
    scene.call("device/enable", True)
    scene.press()
    scene.send(((0.001, 0.0), 0.5))
    assert scene.refuses(Rule.HOMED_FIRST)


def forward_only() -> None:
    """A step does not withdraw the needle."""
    scene = Scene()
    scene.ready()
    scene.until_done(scene.step())
    scene.step(-0.001)
    assert scene.refuses(Rule.FORWARD_ONLY)


def max_depth() -> None:
    """No step ends beyond the largest depth."""
    scene = Scene({"max_depth": 0.02})
    scene.ready()
    for _ in range(10):
        scene.until_done(scene.step(0.00199, 0.0))
    scene.step(0.0002, 0.0)
    assert scene.refuses(Rule.MAX_DEPTH)


def max_step_length() -> None:
    """No step is longer than 2 mm."""
    scene = Scene()
    scene.ready()
    scene.step(0.0021)
    assert scene.refuses(Rule.MAX_STEP_LENGTH)


def max_speed() -> None:
    """No step is faster than 5 mm/s."""
    scene = Scene()
    scene.ready()
    scene.step(0.002, 0.0, 0.39)
    assert scene.refuses(Rule.MAX_SPEED)


def max_rotation_step() -> None:
    """No step turns by more than 1.2 rad."""
    scene = Scene()
    scene.ready()
    scene.step(turn=1.21)
    assert scene.refuses(Rule.MAX_ROTATION_STEP)


def max_rotation_rate() -> None:
    """No step turns faster than 3.14 rad/s."""
    scene = Scene()
    scene.ready()
    scene.step(0.001, 1.1, 0.34)
    assert scene.refuses(Rule.MAX_ROTATION_RATE)


def max_turns() -> None:
    """No step turns the needle beyond its cable limit."""
    scene = Scene({"max_turns": 0.25})
    scene.ready()
    scene.until_done(scene.step())
    scene.step()
    assert scene.refuses(Rule.MAX_TURNS)


def coordinated() -> None:
    """Rotation follows insertion in proportion, also while the speed scale changes."""
    scene = Scene()
    scene.ready()
    scene.hand.places.clear()
    stamp = scene.step()
    scene.runner.run(0.2)
    scene.hand.held = Held(True, 0.3)
    scene.until_done(stamp)
    begin, end = scene.hand.places[0], scene.hand.places[-1]
    for at in scene.hand.places:
        insertion, rotation = (
            (now - first) / (last - first) for now, first, last in zip(at, begin, end, strict=True)
        )
        assert abs(insertion - rotation) < 0.005


def homing_needle_out() -> None:
    """Homing needs the confirmation that the needle is out."""
    scene = Scene()
    scene.until(lambda: scene.state == "DISABLED", "the driver")
    scene.hand.answers.clear()
    scene.hand.actions.append(Call("device/home"))
    assert scene.is_at_rest(1.0)
    assert [answer.success for answer in scene.hand.answers] == [False]


SCENES = (
    hold_new_press, hold_one_owner, hold_in_order, speed_scale, one_device,
    command_state, command_one_publisher, command_form, command_finite,
    command_newer, tip_age, homed_first, forward_only, max_depth, max_step_length, max_speed,
    max_rotation_step, max_rotation_rate, max_turns, coordinated, homing_needle_out,
)  # fmt: skip
