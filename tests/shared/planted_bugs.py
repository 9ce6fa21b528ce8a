"""Bugs that are planted: one for each invariant at least, and those that a schedule once found."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from mcap.writer import Writer

from needle_bags.format.bag_writer import BagWriter
from needle_bags.recording.recording import Received, Recording
from needle_bringup.operator.joy_source import JoySource
from needle_console.hold import page_session
from needle_console.hold.page_session import PageSession
from needle_controller.controller_status import controller_status
from needle_controller.laws.roll_law import RollLaw
from needle_core.messages import HoldState
from needle_device_driver import device_driver
from needle_device_driver.cia402 import cia402_axis, drive_upkeep
from needle_device_driver.cia402.drive_machine import DriveMachine
from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.device import DeviceRows
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.reports import Reply
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.drives.emulated_bus import AxisState, EmulatedBus
from scenario import link_faults, rig_run
from scenario.judging import limit_witness
from scenario.judging.hold_witness import HoldWitness
from scenario.judging.invariants import Watch

Plant = Callable[[pytest.MonkeyPatch], None]


class PlantedBug(NamedTuple):
    """A bug, what finds it, and the first seed from 1 on that does.

    The faults are those of the same seed, or of `faults_of` for a bug that few schedules show.
    """

    invariant: str
    plant: Plant
    seed: int
    faults_of: int | None = None


def _hold_never_lapses(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Hold, "is_fresh", lambda hold, _: hold.owner is not None)


def _old_press_counts(patch: pytest.MonkeyPatch) -> None:
    receive = Hold.receive

    def armed(hold: Hold, message: HoldState, now: float, *, counting: bool) -> Any:
        if (source := hold._sources.get(message.source)) is not None:
            source.released = True
        return receive(hold, message, now, counting=counting)

    patch.setattr(Hold, "receive", armed)


def _press_beside_the_owner_waits(patch: pytest.MonkeyPatch) -> None:
    receive = Hold.receive

    def waiting(hold: Hold, message: HoldState, now: float, *, counting: bool) -> Any:
        beside = hold.owner not in (None, message.source)
        rule = receive(hold, message, now, counting=counting)
        if beside and message.source in hold._sources:
            hold._sources[message.source].released = True
        return rule

    patch.setattr(Hold, "receive", waiting)


def _anybody_keeps_a_hold_fresh(patch: pytest.MonkeyPatch) -> None:
    def anybodys(hold: Hold) -> float:
        return max((one.until for one in hold._sources.values()), default=-math.inf)

    patch.setattr(Hold, "until", property(anybodys))


def _hold_of_a_page_outlives_its_words(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(page_session, "ECHO_AGE_LIMIT", 2.0)


def _lost_press_of_a_page_goes_on(patch: pytest.MonkeyPatch) -> None:
    lapses = PageSession.lapses

    def forgiving(session: PageSession, now: float) -> bool:
        lapsed = lapses(session, now)
        session._armed = session._armed or lapsed
        return lapsed

    patch.setattr(PageSession, "lapses", forgiving)


def _screw_of_twice_the_lead(patch: pytest.MonkeyPatch) -> None:
    axes = EmulatedBus.axes

    def doubled(bus: EmulatedBus, now: float) -> dict[str, AxisState]:
        true = axes(bus, now)
        along = true["insertion"]
        return true | {"insertion": AxisState(2.0 * along.position, 2.0 * along.velocity)}

    patch.setattr(EmulatedBus, "axes", doubled)


def _cycle_that_orders_twice(patch: pytest.MonkeyPatch) -> None:
    drive = DeviceCore.drive

    def twice(core: DeviceCore, period: float, speed_scale: float, now: float) -> None:
        drive(core, period, speed_scale, now)
        drive(core, period, speed_scale, now)

    patch.setattr(DeviceCore, "drive", twice)


def _motion_kept_quiet(patch: pytest.MonkeyPatch) -> None:
    is_news = DeviceRows._is_news

    def some(rows: DeviceRows, status: Any, now: float) -> bool:
        return status.state != State.MOVING.value and is_news(rows, status, now)

    patch.setattr(DeviceRows, "_is_news", some)


def _fault_without_a_word(patch: pytest.MonkeyPatch) -> None:
    fail = DeviceCore.fail
    patch.setattr(DeviceCore, "fail", lambda core, _, rule=None: fail(core, "", rule))


def _insertion_told_too_deep(patch: pytest.MonkeyPatch) -> None:
    def scaled(steering: Any, preset: str, source: str) -> Any:
        status = controller_status(steering, preset, source)
        return dataclasses.replace(status, insertion_m=1.1 * steering.insertion)

    patch.setattr("needle_controller.plane_controller.controller_status", scaled)


def _rotation_wired_the_wrong_way(patch: pytest.MonkeyPatch) -> None:
    axes = EmulatedBus.axes

    def wired(bus: EmulatedBus, now: float) -> dict[str, AxisState]:
        true = axes(bus, now)
        turned = true["rotation"]
        return true | {"rotation": AxisState(-turned.position, -turned.velocity)}

    patch.setattr(EmulatedBus, "axes", wired)


def _estop_unheard(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(MotionSupervisor, "receive_estop", lambda *_: None)


def _reset_refused(patch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        yield from ()
        return Reply(False, "no")

    patch.setattr(MotionSupervisor, "reset", refuse)


def _law_turns_away(patch: pytest.MonkeyPatch) -> None:
    law = RollLaw.__call__

    def away(*arguments: Any) -> Any:
        command = law(*arguments)
        return dataclasses.replace(command, rotation_rate=-command.rotation_rate)

    patch.setattr(RollLaw, "__call__", away)


def _queue_without_a_bound(patch: pytest.MonkeyPatch) -> None:
    def append(recording: Recording, message: Received) -> None:
        recording.append_all((message,))

    patch.setattr(Recording, "append", append)


def _drops_uncounted(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Recording, "_drop", lambda *_: None)


def _never_written_out(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(BagWriter, "flush", lambda _: None)


PLANTED = {
    "a hold that never lapses": PlantedBug("no_motion_without_hold", _hold_never_lapses, 56),
    "a press from before": PlantedBug("no_motion_by_itself", _old_press_counts, 143),
    "a press beside the owner waits": PlantedBug(
        "no_motion_by_another", _press_beside_the_owner_waits, 235
    ),
    "a hold that anybody keeps": PlantedBug(
        "no_motion_by_another", _anybody_keeps_a_hold_fresh, 16, faults_of=466
    ),
    "a page's hold that outlives its words": PlantedBug(
        "hold_is_of_now", _hold_of_a_page_outlives_its_words, 73
    ),
    "a page's lost press that goes on": PlantedBug(
        "hold_is_of_now", _lost_press_of_a_page_goes_on, 15
    ),
    "a screw of twice the lead": PlantedBug("none_beyond_limits", _screw_of_twice_the_lead, 1),
    "a cycle that orders twice": PlantedBug("none_beyond_limits", _cycle_that_orders_twice, 1),
    "a motion kept quiet": PlantedBug("status_is_true", _motion_kept_quiet, 1),
    "a fault without a word": PlantedBug("faults_are_named", _fault_without_a_word, 7),
    "an insertion told too deep": PlantedBug("belief_equals_joints", _insertion_told_too_deep, 2),
    "rotation the wrong way": PlantedBug("turns_as_commanded", _rotation_wired_the_wrong_way, 1),
    "an emergency stop unheard": PlantedBug("estop_stops", _estop_unheard, 40),
    "a reset refused": PlantedBug("the_way_goes_on", _reset_refused, 7),
    "a queue without a bound": PlantedBug("queues_are_bounded", _queue_without_a_bound, 608),
    "a message dropped unsaid": PlantedBug("nothing_recorded_is_lost", _drops_uncounted, 28),
    "a bag kept in memory": PlantedBug("nothing_recorded_is_lost", _never_written_out, 10),
    "a law that turns away": PlantedBug("undisturbed_converges", _law_turns_away, 100),
}


def _bag_begins_without_writing(patch: pytest.MonkeyPatch) -> None:
    begin = BagWriter._begin_file

    def unwritten(bag: BagWriter) -> None:
        with pytest.MonkeyPatch.context() as meanwhile:
            meanwhile.setattr(Writer, "flush", lambda *_: None)
            begin(bag)

    patch.setattr(BagWriter, "_begin_file", unwritten)


class MendedBug(NamedTuple):
    """A bug of the rig, or of the soak's own judges, and what it violates under its schedule."""

    invariant: str
    plant: Plant


def _blocked_axis_keeps_its_power(patch: pytest.MonkeyPatch) -> None:
    update = DriveMachine.update

    def unaware(machine: DriveMachine, at: Feedback) -> None:
        update(machine, dataclasses.replace(at, following_error=0))

    patch.setattr(DriveMachine, "update", unaware)


def _start_within_set_up_forgotten(patch: pytest.MonkeyPatch) -> None:
    await_start = drive_upkeep.await_start

    def forgetful(link: Any, monitor: Any, *others: Any) -> Any:
        yield from await_start(link, monitor, *others)
        monitor.forget_start()

    patch.setattr(cia402_axis, "await_start", forgetful)


def _reliable_messages_overtake(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(link_faults, "_RESENT", {})


def _overtaken_joystick_counts(patch: pytest.MonkeyPatch) -> None:
    take = JoySource.take

    def unstamped(source: JoySource, axes: Any, buttons: Any, now: float, **_: float) -> None:
        take(source, axes, buttons, now)

    patch.setattr(JoySource, "take", unstamped)


def _emergency_stop_ends_the_search(patch: pytest.MonkeyPatch) -> None:
    set_up = DeviceDriver._setting_up

    def unless_stopped(driver: DeviceDriver, now: float) -> Any:
        driver.searches = driver.supervisor.state is not State.ESTOPPED
        return (yield from set_up(driver, now))

    patch.setattr(DeviceDriver, "_setting_up", unless_stopped)


def _set(owner: Any, **values: Any) -> Plant:
    def plant(patch: pytest.MonkeyPatch) -> None:
        for name, value in values.items():
            patch.setattr(owner, name, value)

    return plant


def _judge_forgets(**values: float) -> Plant:
    see_device = Watch.see_device

    def forgetful(watch: Watch, at: float, said: Any) -> None:
        see_device(watch, at, said)
        vars(watch).update(values)

    return _set(Watch, see_device=forgetful)


def _judge_of_drives_never_behind(patch: pytest.MonkeyPatch) -> None:
    bounds = dataclasses.replace(
        SafetyLimits(), insertion_following_error=1e-6, rotation_following_error=1e-6
    )
    patch.setattr(rig_run, "SafetyLimits", lambda: bounds)
    patch.setattr(limit_witness, "_SET_POINTS_BEHIND", 1)


def _loss_within_set_up_is_no_answer(patch: pytest.MonkeyPatch) -> None:
    # What nobody raises.
    patch.setattr(device_driver, "LinkError", KeyboardInterrupt)


def _stuck_fault_is_not_set_up_again(patch: pytest.MonkeyPatch) -> None:
    # What nobody raises.
    patch.setattr(cia402_axis, "StuckFaultError", KeyboardInterrupt)


MENDED = {
    "a_set_up_on_a_bus_that_repeats": MendedBug(
        "the_way_goes_on", _stuck_fault_is_not_set_up_again
    ),
    "an_adapter_lost_as_drives_say_who_they_are": MendedBug(
        "no_node_crashes", _loss_within_set_up_is_no_answer
    ),
    "an_emergency_stop_while_drives_are_waited_for": MendedBug(
        "the_way_goes_on", _emergency_stop_ends_the_search
    ),
    "a_recorder_begins_on_a_broken_disk": MendedBug(
        "nothing_recorded_is_lost", _bag_begins_without_writing
    ),
    "blocked_when_the_hold_is_let_go": MendedBug(
        "no_motion_without_hold", _blocked_axis_keeps_its_power
    ),
    "a_drive_starts_anew_within_its_set_up": MendedBug(
        "the_way_goes_on", _start_within_set_up_forgotten
    ),
    "a_reliable_topic_out_of_order": MendedBug("the_way_goes_on", _reliable_messages_overtake),
    "a_blocked_drive_catches_up": MendedBug("none_beyond_limits", _judge_of_drives_never_behind),
    "set_points_come_twice": MendedBug("none_beyond_limits", _judge_of_drives_never_behind),
    "set_points_come_late": MendedBug("none_beyond_limits", _judge_of_drives_never_behind),
    "old_set_points_come_after_new_ones": MendedBug(
        "none_beyond_limits", _judge_of_drives_never_behind
    ),
    "a_fault_ends_homing_on_a_late_bus": MendedBug(
        "no_motion_without_hold", _judge_forgets(_homing_until=-1.0)
    ),
    "a_rebooted_drive_is_homed_where_it_stands": MendedBug(
        "turns_as_commanded", _judge_forgets(_zero=0.0)
    ),
    "an_overtaken_release": MendedBug("no_motion_by_itself", _overtaken_joystick_counts),
    "a_driver_killed_under_a_press": MendedBug(
        "no_motion_by_another", _set(HoldWitness, lose_device=lambda *_: None)
    ),
}
"""By the schedule, in tests/scenario/tests/schedules, that found them."""
