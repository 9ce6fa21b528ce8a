"""Bugs that disable a safety rule, planted in the code that enforces it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest

from needle_core.messages import HoldState
from needle_device_driver.axes.axis import AxisPair, PairSnapshot
from needle_device_driver.axes.motion import CoordinatedMotion, Leg
from needle_device_driver.axes.speed_monitor import SpeedMonitor
from needle_device_driver.cia402 import cia402_axis
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.supervisor import command
from needle_device_driver.supervisor.command import CommandHandler
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_device_driver.supervisor.motion_run import HomingTimes, MotionRun, RetractionBound
from needle_device_driver.supervisor.states import Activity, State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

Plant = Callable[[pytest.MonkeyPatch], None]


def set_to(where: Any, /, **values: Any) -> Plant:
    """Return a bug that replaces attributes of a class or module."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        for name, value in values.items():
            patch.setattr(where, name, value)

    return plant


def wrapped(where: Any, name: str, around: Callable[..., Any]) -> Plant:
    """Return a bug that wraps a function; the wrapper gets the original as its first argument."""
    original = getattr(where, name)
    return set_to(where, **{name: lambda *given, **named: around(original, *given, **named)})


def _do_nothing(*_: Any, **__: Any) -> None:
    """Do nothing, and report no error."""


def _empty_procedure(*_: Any, **__: Any) -> Any:
    """Do nothing, as a procedure."""
    yield from ()


def _of_context(**wrong: Any) -> Plant:
    """Return a bug that checks commands in a wrong context."""

    def checked(check: Any, asked: Any, context: Any, limits: Any) -> Any:
        return check(asked, dataclasses.replace(context, **wrong), limits)

    return wrapped(command, "check_command", checked)


def _of_messages(change: Callable[[Hold, HoldState], HoldState]) -> Plant:
    """Return a bug that changes each received hold."""

    def received(receive: Any, hold: Hold, message: HoldState, *more: Any, **how: Any) -> Any:
        return receive(hold, change(hold, message), *more, **how)

    return wrapped(Hold, "receive", received)


def _accept_old_press(hold: Hold, message: HoldState) -> HoldState:
    if message.source in hold._sources:
        hold._sources[message.source].released = True
    return message


def _drop_owner(hold: Hold, message: HoldState) -> HoldState:
    hold._owner = None
    return message


def _accept_any_order(hold: Hold, message: HoldState) -> HoldState:
    known = hold._sources.get(message.source)
    return message if known is None else dataclasses.replace(message, count=known.count + 1)


def _ignore_speed_scale(hold: Hold, message: HoldState) -> HoldState:
    return dataclasses.replace(message, speed_scale=1.0)


def _move_on_enable(patch: pytest.MonkeyPatch) -> None:
    may_move, enable = MotionSupervisor.may_move, MotionSupervisor.enable

    def enabled(supervisor: MotionSupervisor, on: bool, now: float) -> Any:
        reply = enable(supervisor, on, now)
        if on and reply.success and supervisor.status(now).homed:
            at = supervisor._core.poll(now)
            ahead = Leg(at.insertion.position + 0.001, at.rotation.position, 0.5)
            supervisor._core.start(Activity.STEP, [ahead])
        return reply

    patch.setattr(MotionSupervisor, "enable", enabled)
    patch.setattr(
        MotionSupervisor,
        "may_move",
        lambda supervisor, now: supervisor.state is State.MOVING or may_move(supervisor, now),
    )
    patch.setattr(DeviceCore, "needs_hold", property(lambda _: False))
    patch.setattr(Hold, "speed_scale", property(lambda _: 1.0))


def _delay_rotation(advance: Any, motion: CoordinatedMotion, *given: float) -> Any:
    before = motion._at
    point = advance(motion, *given)
    return point if motion.complete else dataclasses.replace(point, rotation=before[1])


def _insertion_only(pair: AxisPair, order: Callable[[Any], None]) -> None:
    order(pair.insertion)


def _home_unconfirmed(home: Any, supervisor: MotionSupervisor, now: float) -> Any:
    supervisor._needle_out = True
    return home(supervisor, now)


_ignore_faults = set_to(Cia402Axis, _fault=property(lambda _: None))
_any_bounds = set_to(command, _check_bounds=_do_nothing)
_ignore_motion_errors = set_to(MotionRun, problem=_do_nothing)


def _all_of(*plants: Plant) -> Plant:
    def plant(patch: pytest.MonkeyPatch) -> None:
        for one in plants:
            one(patch)

    return plant


_set_points_far_ahead = _all_of(
    wrapped(CoordinatedMotion, "advance", lambda f, motion, t, scale: f(motion, 10.0 * t, scale)),
    wrapped(DriveSettings, "magnitude", lambda f, settings, value: 20 * f(settings, value)),
    _ignore_motion_errors,
)
_homing_never_ends = _all_of(_ignore_faults, set_to(HomingTimes, advance=lambda *_: ""))
_axes_drift_apart = _all_of(_ignore_motion_errors, _ignore_faults)

BUGS: dict[str, Plant] = {
    "hold_to_run": set_to(Hold, owner=property(lambda _: "hand")),
    "hold_age": set_to(Hold, is_fresh=lambda *_: True),
    "hold_new_press": _of_messages(_accept_old_press),
    "hold_one_owner": _of_messages(_drop_owner),
    "hold_in_order": _of_messages(_accept_any_order),
    "speed_scale": _of_messages(_ignore_speed_scale),
    "one_device": set_to(MotionSupervisor, report_conflicting_device=_do_nothing),
    "no_motion_by_itself": _move_on_enable,
    "command_state": set_to(
        CommandHandler, _check_device=lambda handler, _, now: handler._core.poll(now)
    ),
    "command_one_publisher": _of_context(publishers=1),
    "command_form": set_to(command, check_form=_do_nothing),
    "command_finite": set_to(math, isfinite=lambda _: True),
    "command_newer": _of_context(not_new=""),
    "tip_age": _of_context(tip_age=0.0),
    "homed_first": _of_context(homed=True),
    "forward_only": _any_bounds,
    "max_depth": _any_bounds,
    "max_step_length": _any_bounds,
    "max_speed": _any_bounds,
    "max_rotation_step": _any_bounds,
    "max_rotation_rate": _any_bounds,
    "max_turns": _any_bounds,
    "coordinated": wrapped(CoordinatedMotion, "advance", _delay_rotation),
    "following_error": _axes_drift_apart,
    "retraction": set_to(DeviceCore, retraction_distance=property(lambda _: 0.0)),
    "unhomed_outward_only": set_to(RetractionBound, target=lambda _, at: at.position),
    "homing_needle_out": wrapped(MotionSupervisor, "home", _home_unconfirmed),
    "homing_time": _homing_never_ends,
    "estop_latches": set_to(MotionSupervisor, receive_estop=_do_nothing),
    "one_fault_stops_both": set_to(AxisPair, each=_insertion_only),
    "inner_limit_switch": _ignore_motion_errors,
    "reply_age": set_to(PairSnapshot, age=lambda *_: 0.0),
    "axis_speed": set_to(SpeedMonitor, check=lambda *_, **__: True),
    "settling_time": _ignore_motion_errors,
    "link_loss": set_to(DeviceDriver, _on_port_change=_empty_procedure),
    "one_master": _ignore_faults,
    "drive_watchdog": set_to(cia402_axis, arm_watchdog=_empty_procedure),
    "drive_emergency": _ignore_faults,
    "drive_reboot": _ignore_faults,
    "quick_stop": set_to(Cia402Axis, stop=_do_nothing),
    "software_limits": set_to(cia402_axis, write_limits=_empty_procedure),
    "look_ahead": _set_points_far_ahead,
    "loop_heartbeat": set_to(FrameLink, beat=_do_nothing),
}
"""Bugs by the name of the rule."""
