"""Planted bugs: at least one per invariant, and those found by a schedule."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import pytest

from needle_bags.format.bag_writer import BagWriter
from needle_bags.recording.recording import Received, Recording
from needle_bringup.operator.joy_source import JoySource
from needle_console.hold import page_session
from needle_console.hold.page_session import PageSession
from needle_controller import plane_controller
from needle_controller.laws.roll_law import RollLaw
from needle_core.messages import HoldState
from needle_device_driver import device_driver
from needle_device_driver.cia402 import cia402_axis
from needle_device_driver.cia402.drive_machine import DriveMachine
from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.device import DeviceInterface
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.reports import ServiceResult
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.drives.emulated_drives import AxisState, EmulatedDrives
from scenario import link_faults, rig_run
from scenario.monitors import limit_monitor
from scenario.monitors.hold_monitor import HoldMonitor
from scenario.monitors.invariants import InvariantMonitor
from scenario.rules.bugs import BUGS, Plant, set_to, wrapped

NEVER_RAISED = KeyboardInterrupt


class PlantedBug(NamedTuple):
    """A bug, the invariant that detects it, and the first seed from 1 that does.

    The faults are those of the same seed, or of `faults_of` for a bug that few schedules show.
    """

    invariant: str
    plant: Plant
    seed: int
    faults_of: int | None = None


def _queue_second_press(receive: Any, hold: Hold, message: HoldState, *a: Any, **k: Any) -> Any:
    beside = hold.owner not in (None, message.source)
    rule = receive(hold, message, *a, **k)
    if beside and message.source in hold._sources:
        hold._sources[message.source].released = True
    return rule


def _until_of_any_source(hold: Hold) -> float:
    return max((one.until for one in hold._sources.values()), default=-math.inf)


def _rearm_when_stale(lapses: Any, session: PageSession, now: float) -> bool:
    lapsed = bool(lapses(session, now))
    session._armed = session._armed or lapsed
    return lapsed


def _axis_scaled(name: str, scale: float) -> Plant:
    """Return a bug that scales the motion of an emulated axis."""

    def axes(true: Any, bus: EmulatedDrives, now: float) -> dict[str, AxisState]:
        found: dict[str, AxisState] = true(bus, now)
        at = found[name]
        return found | {name: AxisState(scale * at.position, scale * at.velocity)}

    return wrapped(EmulatedDrives, "axes", axes)


def _drive_twice(drive: Any, *given: Any) -> None:
    drive(*given)
    drive(*given)


def _hide_motion(is_new: Any, device: DeviceInterface, status: Any, now: float) -> bool:
    return status.state != State.MOVING.value and bool(is_new(device, status, now))


def _report_too_deep(controller_status: Any, steering: Any, *more: Any) -> Any:
    return dataclasses.replace(
        controller_status(steering, *more), insertion_m=1.1 * steering.insertion
    )


def _refuse(*_: Any) -> Any:
    yield from ()
    return ServiceResult(False, "no")


def _turn_away(law: Any, *given: Any) -> Any:
    command = law(*given)
    return dataclasses.replace(command, rotation_rate=-command.rotation_rate)


def _append_all(recording: Recording, message: Received) -> None:
    recording.append_all((message,))


_PLANTED: dict[str, tuple[Any, ...]] = {
    "a hold that never lapses": (
        "no_motion_without_hold",
        set_to(Hold, is_fresh=lambda hold, _: hold.owner is not None),
        56,
    ),
    "a press from before": ("no_motion_by_itself", BUGS["hold_new_press"], 143),
    "a press during another hold is queued": (
        "no_motion_by_another",
        wrapped(Hold, "receive", _queue_second_press),
        235,
    ),
    "a hold that any source extends": (
        "no_motion_by_another",
        set_to(Hold, until=property(_until_of_any_source)),
        16,
        466,
    ),
    "a page's hold that outlives its messages": (
        "hold_is_current",
        set_to(page_session, ECHO_AGE_LIMIT=2.0),
        73,
    ),
    "a page's lost press that resumes": (
        "hold_is_current",
        wrapped(PageSession, "end_if_stale", _rearm_when_stale),
        15,
    ),
    "a screw of twice the lead": ("none_beyond_limits", _axis_scaled("insertion", 2.0), 1),
    "a cycle that orders twice": (
        "none_beyond_limits",
        wrapped(DeviceCore, "drive", _drive_twice),
        1,
    ),
    "an unreported motion": (
        "status_is_true",
        wrapped(DeviceInterface, "_is_new", _hide_motion),
        1,
    ),
    "a fault without a reason": (
        "faults_are_named",
        wrapped(DeviceCore, "fail", lambda fail, core, _, rule=None: fail(core, "", rule)),
        7,
    ),
    "an insertion reported too deep": (
        "depth_matches_joints",
        wrapped(plane_controller, "controller_status", _report_too_deep),
        2,
    ),
    "rotation the wrong way": ("turns_as_commanded", _axis_scaled("rotation", -1.0), 1),
    "an ignored emergency stop": ("estop_stops", BUGS["estop_latches"], 40),
    "a reset refused": ("run_can_continue", set_to(MotionSupervisor, reset=_refuse), 7),
    "a queue without a bound": ("queues_are_bounded", set_to(Recording, append=_append_all), 608),
    "a silently dropped message": (
        "nothing_recorded_is_lost",
        set_to(Recording, _drop=lambda *_: None),
        68,
    ),
    "a bag kept in memory": (
        "nothing_recorded_is_lost",
        set_to(BagWriter, flush=lambda _: None),
        10,
    ),
    "a law that turns away": (
        "undisturbed_converges",
        wrapped(RollLaw, "__call__", _turn_away),
        100,
    ),
}
PLANTED = {name: PlantedBug(*row) for name, row in _PLANTED.items()}


def _unaware(update: Any, machine: DriveMachine, at: Feedback) -> None:
    update(machine, dataclasses.replace(at, following_error=0))


def _forgetful(await_start: Any, link: Any, monitor: Any, *others: Any) -> Any:
    yield from await_start(link, monitor, *others)
    monitor.clear_reboot()


def _unstamped(
    receive: Any, source: JoySource, axes: Any, buttons: Any, now: float, **_: Any
) -> None:
    receive(source, axes, buttons, now)


def _unless_stopped(set_up: Any, driver: DeviceDriver, now: float) -> Any:
    driver.searches = driver.supervisor.state is not State.ESTOPPED
    return (yield from set_up(driver, now))


def _monitor_forgets(**values: float) -> Plant:
    def forgetful(observe_device: Any, watch: InvariantMonitor, at: float, status: Any) -> None:
        observe_device(watch, at, status)
        vars(watch).update(values)

    return wrapped(InvariantMonitor, "observe_device", forgetful)


def _monitor_of_drives_never_behind(patch: pytest.MonkeyPatch) -> None:
    bounds = dataclasses.replace(
        SafetyLimits(), insertion_following_error=1e-6, rotation_following_error=1e-6
    )
    patch.setattr(rig_run, "SafetyLimits", lambda: bounds)
    patch.setattr(limit_monitor, "_SET_POINTS_BEHIND", 1)


_MENDED: dict[str, tuple[str, Plant]] = {
    "a_set_up_on_a_bus_that_repeats": (
        "run_can_continue",
        set_to(cia402_axis, StuckFaultError=NEVER_RAISED),
    ),
    "an_adapter_lost_during_identification": (
        "no_node_crashes",
        set_to(device_driver, LinkError=NEVER_RAISED),
    ),
    "an_emergency_stop_while_drives_are_waited_for": (
        "run_can_continue",
        wrapped(DeviceDriver, "_set_up_drives", _unless_stopped),
    ),
    "blocked_at_the_release_of_the_hold": (
        "no_motion_without_hold",
        wrapped(DriveMachine, "update", _unaware),
    ),
    "a_drive_restarts_during_its_set_up": (
        "run_can_continue",
        wrapped(cia402_axis, "await_start", _forgetful),
    ),
    "a_reliable_topic_out_of_order": ("run_can_continue", set_to(link_faults, _RESENT={})),
    "a_blocked_drive_catches_up": ("none_beyond_limits", _monitor_of_drives_never_behind),
    "set_points_come_twice": ("none_beyond_limits", _monitor_of_drives_never_behind),
    "set_points_come_late": ("none_beyond_limits", _monitor_of_drives_never_behind),
    "old_set_points_come_after_new_ones": ("none_beyond_limits", _monitor_of_drives_never_behind),
    "a_fault_ends_homing_on_a_late_bus": (
        "no_motion_without_hold",
        _monitor_forgets(_homing_until=-1.0),
    ),
    "a_rebooted_drive_is_homed_at_its_position": (
        "turns_as_commanded",
        _monitor_forgets(_zero=0.0),
    ),
    "an_overtaken_release": ("no_motion_by_itself", wrapped(JoySource, "receive", _unstamped)),
    "a_driver_killed_under_a_press": (
        "no_motion_by_another",
        set_to(HoldMonitor, lose_device=lambda *_: None),
    ),
}
MENDED = {name: PlantedBug(*row, seed=0) for name, row in _MENDED.items()}
"""Bugs by the schedule in tests/scenario/tests/schedules that found them, with its seed."""
