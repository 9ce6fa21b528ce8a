"""Bugs that take a safety rule away, planted where the rule is enforced."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest

from needle_core.messages import HoldState
from needle_device_driver.axes.axis_pair import AxisPair, PairSnapshot
from needle_device_driver.axes.motion import CoordinatedMotion, Leg
from needle_device_driver.cia402 import cia402_axis
from needle_device_driver.cia402.axis_speed import SpeedWatch
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.supervisor import command, command_desk
from needle_device_driver.supervisor.command_desk import CommandDesk
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_device_driver.supervisor.homing_times import HomingTimes
from needle_device_driver.supervisor.motion_run import MotionRun
from needle_device_driver.supervisor.retraction_bound import RetractionBound
from needle_device_driver.supervisor.states import Activity, State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

Plant = Callable[[pytest.MonkeyPatch], None]


def _set(where: Any, /, **values: Any) -> Plant:
    def plant(patch: pytest.MonkeyPatch) -> None:
        for name, value in values.items():
            patch.setattr(where, name, value)

    return plant


def _unheard(*_: Any, **__: Any) -> None:
    """Do nothing, and find nothing wrong."""


def _nothing_sent(*_: Any, **__: Any) -> Any:
    """Do nothing, as a procedure."""
    yield from ()


def _of_context(**wrong: Any) -> Plant:
    """Judge commands as if the device were otherwise."""
    check = command.check_command

    def checked(asked: Any, context: Any, limits: Any) -> Any:
        return check(asked, dataclasses.replace(context, **wrong), limits)

    return _set(command_desk, check_command=checked)


def _of_messages(change: Callable[[Hold, HoldState], HoldState]) -> Plant:
    """Take another message than the one that came."""
    receive = Hold.receive

    def received(hold: Hold, message: HoldState, now: float, *, counting: bool) -> Any:
        return receive(hold, change(hold, message), now, counting=counting)

    return _set(Hold, receive=received)


def _press_counts(hold: Hold, message: HoldState) -> HoldState:
    if message.source in hold._sources:
        hold._sources[message.source].released = True
    return message


def _owner_is_robbed(hold: Hold, message: HoldState) -> HoldState:
    hold._owner = None
    return message


def _order_is_made_up(hold: Hold, message: HoldState) -> HoldState:
    known = hold._sources.get(message.source)
    return message if known is None else dataclasses.replace(message, count=known.count + 1)


def _scale_is_one(hold: Hold, message: HoldState) -> HoldState:
    return dataclasses.replace(message, speed_scale=1.0)


def _enabling_moves(patch: pytest.MonkeyPatch) -> None:
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
    patch.setattr(DeviceCore, "moves_with_hold", property(lambda _: False))
    patch.setattr(Hold, "speed_scale", property(lambda _: 1.0))


def _rotation_comes_late(patch: pytest.MonkeyPatch) -> None:
    advance = CoordinatedMotion.advance

    def late(motion: CoordinatedMotion, period: float, speed_scale: float) -> Any:
        before = motion._at
        point = advance(motion, period, speed_scale)
        return point if motion.complete else dataclasses.replace(point, rotation=before[1])

    patch.setattr(CoordinatedMotion, "advance", late)


def _only_insertion_is_told(pair: AxisPair, order: Callable[[Any], None]) -> None:
    order(pair.insertion)


def _homing_needs_no_word(patch: pytest.MonkeyPatch) -> None:
    home = MotionSupervisor.home

    def homed(supervisor: MotionSupervisor, now: float) -> Any:
        supervisor._needle_out = True
        return (yield from home(supervisor, now))

    patch.setattr(MotionSupervisor, "home", homed)


def _set_points_far_ahead(patch: pytest.MonkeyPatch) -> None:
    advance, magnitude = CoordinatedMotion.advance, DriveSettings.magnitude
    patch.setattr(
        CoordinatedMotion,
        "advance",
        lambda motion, period, scale: advance(motion, 10.0 * period, scale),
    )
    patch.setattr(
        DriveSettings,
        "magnitude",
        lambda settings, value: 20 * magnitude(settings, value),
    )
    patch.setattr(MotionRun, "problem", _unheard)


_faults_unheard = _set(Cia402Axis, _fault=property(lambda _: None))
_any_bounds = _set(command, _check_bounds=_unheard)
_motion_unwatched = _set(MotionRun, problem=_unheard)


def _homing_takes_for_ever(patch: pytest.MonkeyPatch) -> None:
    _faults_unheard(patch)
    patch.setattr(HomingTimes, "count", lambda *_: "")


def _axes_drift_apart(patch: pytest.MonkeyPatch) -> None:
    _motion_unwatched(patch)
    _faults_unheard(patch)


BUGS: dict[str, Plant] = {
    "hold_to_run": _set(Hold, owner=property(lambda _: "hand")),
    "hold_age": _set(Hold, is_fresh=lambda *_: True),
    "hold_new_press": _of_messages(_press_counts),
    "hold_one_owner": _of_messages(_owner_is_robbed),
    "hold_in_order": _of_messages(_order_is_made_up),
    "speed_scale": _of_messages(_scale_is_one),
    "one_device": _set(MotionSupervisor, see_others=_unheard),
    "no_motion_by_itself": _enabling_moves,
    "command_state": _set(CommandDesk, _ready_for=lambda desk, _, now: desk._core.poll(now)),
    "command_one_publisher": _of_context(publishers=1),
    "command_form": _set(command, check_form=_unheard),
    "command_finite": _set(math, isfinite=lambda _: True),
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
    "coordinated": _rotation_comes_late,
    "following_error": _axes_drift_apart,
    "retraction": _set(DeviceCore, way_out=property(lambda _: 0.0)),
    "unhomed_outward_only": _set(RetractionBound, target=lambda _, at: at.position),
    "homing_needle_out": _homing_needs_no_word,
    "homing_time": _homing_takes_for_ever,
    "estop_latches": _set(MotionSupervisor, receive_estop=_unheard),
    "one_fault_stops_both": _set(AxisPair, each=_only_insertion_is_told),
    "inner_limit_switch": _motion_unwatched,
    "reply_age": _set(PairSnapshot, age=lambda *_: 0.0),
    "axis_speed": _set(SpeedWatch, judge=lambda *_, **__: True),
    "settling_time": _motion_unwatched,
    "link_loss": _set(DeviceDriver, _on_port_change=_nothing_sent),
    "one_master": _faults_unheard,
    "drive_watchdog": _set(cia402_axis, arm_watchdog=_nothing_sent),
    "drive_emergency": _faults_unheard,
    "drive_reboot": _faults_unheard,
    "quick_stop": _set(Cia402Axis, stop=_unheard),
    "software_limits": _set(cia402_axis, write_limits=_nothing_sent),
    "look_ahead": _set_points_far_ahead,
    "loop_heartbeat": _set(FrameLink, beat=_unheard),
}
"""By the rule's name."""
