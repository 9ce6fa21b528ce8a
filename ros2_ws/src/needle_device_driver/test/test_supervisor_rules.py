"""Each safety rule of docs/safety.md, named as there."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeAlias

import pytest

from needle_common.errors import OutOfBoundsError
from needle_device_driver.command import Command, CommandPoint
from needle_device_driver.limits import SafetyLimits
from needle_device_driver.rules import Rule
from needle_device_driver.states import Activity, State

# conftest's; test modules cannot import it.
Bench: TypeAlias = Any


def in_state(bench: Bench, state: State) -> bool:
    """Return whether the device is in a state, in a way that no type checker remembers."""
    return bool(bench.state is state)


def refused(bench: Bench, rule: Rule) -> str:
    """Check that the last command was refused whole by a rule; return the reason."""
    bench.cycle(3, holding=True)
    assert bench.last_rule is rule
    assert bench.results[-1].outcome.startswith("aborted: ")
    assert not in_state(bench, State.MOVING)
    assert bench.positions == (0.0, 0.0)
    return str(bench.results[-1].outcome)


def test_a_step_goes_exactly_to_its_target_and_answers_with_its_stamp(bench: Bench) -> None:
    bench.ready()
    stamp = bench.command(0.001, -0.3)
    assert in_state(bench, State.MOVING)
    bench.cycle(24, holding=True)
    assert bench.results == []
    bench.cycle(1, holding=True)
    assert bench.positions == (0.001, -0.3)
    assert [(r.stamp_ns, r.outcome) for r in bench.results] == [(stamp, "succeeded")]
    assert in_state(bench, State.HOLDING)


# ---- hold -------------------------------------------------------------------------------------


def test_hold_to_run_release_stops_at_once_and_discards_the_step(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(5, holding=True)
    at = bench.positions
    bench.hold(False)
    assert bench.results[-1].outcome == "aborted: hold released"
    bench.cycle(5)
    bench.hold()
    bench.cycle(5, holding=True)
    assert bench.positions == at
    assert in_state(bench, State.HOLDING)


def test_hold_to_run_without_hold_a_command_is_refused(bench: Bench) -> None:
    bench.ready(holding=False)
    bench.command()
    bench.cycle(3)
    assert bench.last_rule is Rule.HOLD_TO_RUN
    assert bench.positions == (0.0, 0.0)


def test_hold_age_silence_aborts_within_the_timeout_and_takes_a_new_press(bench: Bench) -> None:
    bench.ready()
    bench.command(0.002, 0.1, duration=2.0)
    started = bench.now
    while in_state(bench, State.MOVING):
        bench.cycle()
    assert bench.now - started <= bench.limits.hold_timeout + 2 * bench.period
    assert "no hold message" in bench.results[-1].outcome
    assert bench.status.watchdog_trips == 1
    bench.hold()
    assert bench.status.hold_owner == ""
    bench.hold(False)
    bench.hold()
    assert bench.status.hold_owner == "a"


def test_hold_age_a_gap_that_no_cycle_saw_counts_all_the_same(bench: Bench) -> None:
    bench.ready()
    bench.command(0.002, 0.1, duration=2.0)
    bench.now += 0.3
    bench.hold()
    assert "no hold message" in bench.results[-1].outcome


def test_hold_age_pauses_a_lock_step_simulation_and_goes_on(make_bench: Any) -> None:
    bench = make_bench(pause_on_lapse=True)
    bench.ready()
    bench.command()
    bench.cycle(5, holding=True)
    bench.now += 1.0
    at = bench.positions
    bench.cycle(5)
    assert bench.positions == at
    assert not bench.supervisor.may_move(bench.now)
    assert in_state(bench, State.MOVING)
    assert bench.status.watchdog_trips == 1
    bench.cycle(20, holding=True)
    assert bench.results[-1].outcome == "succeeded"
    bench.command()
    bench.now += 1.0
    bench.hold(False)
    assert bench.results[-1].outcome == "aborted: hold released"


@pytest.mark.parametrize("press_before", ["enable", "reset", "stop"])
def test_hold_new_press_one_from_before_does_not_count(bench: Bench, press_before: str) -> None:
    bench.home()
    if press_before == "enable":
        bench.hold()
        bench.supervisor.enable(True, bench.now)
    else:
        bench.supervisor.enable(True, bench.now)
        bench.hold()
        assert bench.status.hold_owner == "a"
        if press_before == "reset":
            bench.supervisor.reset(bench.now)
        else:
            bench.supervisor.stop()
    bench.cycle(5, holding=True)
    assert bench.status.hold_owner == ""
    assert bench.status.speed_scale == 0.0
    bench.hold(False)
    bench.hold()
    assert bench.status.hold_owner == "a"


def test_hold_one_owner_until_released(bench: Bench) -> None:
    bench.ready()
    bench.hold(sender="b")
    assert bench.status.hold_owner == "a"
    assert bench.last_rule is Rule.HOLD_ONE_OWNER
    bench.hold(False, sender="b")
    bench.command()
    bench.cycle(1, holding=True)
    assert in_state(bench, State.MOVING)
    bench.hold(sender="b")
    bench.hold(False)
    bench.hold(sender="b")
    assert bench.status.hold_owner == "", "b pressed while a had it: that press must not take over"
    bench.hold(False, sender="b")
    bench.hold(sender="b")
    assert bench.status.hold_owner == "b"


def test_hold_one_owner_a_crowd_of_senders_is_refused(bench: Bench) -> None:
    bench.ready(holding=False)
    for number in range(40):
        bench.hold(False, sender=str(number))
    bench.hold(sender="late")
    assert bench.status.hold_owner == ""


def test_hold_stamp_increases_an_old_one_keeps_nothing_alive(bench: Bench) -> None:
    bench.ready(holding=False)
    bench.hold(stamp_ns=50)
    bench.command(0.002, 0.1, duration=2.0)
    for _ in range(20):
        bench.hold(stamp_ns=50)
        bench.cycle()
    assert in_state(bench, State.HOLDING)
    assert bench.results[-1].outcome.startswith("aborted: no hold message")


def test_hold_stamp_increases_yet_an_old_release_still_stops(bench: Bench) -> None:
    bench.ready(holding=False)
    bench.hold(stamp_ns=50)
    bench.command()
    bench.hold(False, stamp_ns=10)
    assert bench.results[-1].outcome == "aborted: hold released"


@pytest.mark.parametrize("scale", [math.nan, -0.1, 1.1, math.inf])
def test_speed_scale_outside_0_to_1_is_a_release(bench: Bench, scale: float) -> None:
    bench.ready()
    bench.command()
    bench.hold(scale=scale)
    assert bench.results[-1].outcome == "aborted: hold released"
    assert bench.last_rule is Rule.SPEED_SCALE


def test_speed_scale_slows_and_0_stands_still(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(10, holding=True, scale=0.5)
    assert bench.insertion.position == pytest.approx(0.0002)
    bench.cycle(10, holding=True, scale=0.0)
    assert bench.insertion.position == pytest.approx(0.0002)
    assert not bench.supervisor.may_move(bench.now)


def test_no_motion_by_itself_on_configure_enable_reset(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(3, holding=True)
    bench.insertion.fault = "stalled"
    bench.cycle(1, holding=True)
    at = bench.positions
    assert in_state(bench, State.FAULT)
    bench.insertion.orders.clear()
    bench.hold(False)
    assert bench.supervisor.reset(bench.now).success
    assert bench.supervisor.enable(True, bench.now).success
    bench.cycle(5)
    bench.cycle(20, holding=True)
    assert bench.positions == at
    assert "move" not in bench.insertion.orders + bench.rotation.orders[-3:]


# ---- commands ---------------------------------------------------------------------------------


def test_command_state_only_in_holding(make_bench: Any) -> None:
    bench = make_bench()
    bench.home()
    bench.command()
    assert bench.last_rule is Rule.COMMAND_STATE
    assert "DISABLED" in bench.results[-1].outcome


def test_command_state_a_second_command_leaves_the_running_step_alone(bench: Bench) -> None:
    bench.ready()
    stamp = bench.command()
    bench.cycle(5, holding=True)
    other = bench.command(0.002, 1.0)
    bench.command(0.002, 1.0, stamp_ns=stamp)
    bench.cycle(20, holding=True)
    assert [(r.stamp_ns, r.outcome) for r in bench.results] == [
        (other, "aborted: the device is MOVING, not HOLDING"),
        (stamp, "succeeded"),
    ]
    assert bench.positions == (0.001, 0.1)


def test_command_one_publisher(bench: Bench) -> None:
    bench.ready()
    bench.command(publishers=2)
    assert "2 nodes" in refused(bench, Rule.COMMAND_ONE_PUBLISHER)


NAMES = ("insertion_joint", "rotation_joint")
POINT = CommandPoint((0.001, 0.1), (), 0.5)


@pytest.mark.parametrize(
    ("names", "points"),
    [
        ((), (POINT,)),
        (("insertion_joint",), (CommandPoint((0.001,), (), 0.5),)),
        (("insertion_joint", "roll"), (POINT,)),
        (("insertion_joint", "insertion_joint"), (POINT,)),
        ((*NAMES, "more"), (CommandPoint((0.001, 0.1, 0.0), (), 0.5),)),
        (NAMES, ()),
        (NAMES, (POINT, POINT)),
        (NAMES, (CommandPoint((0.001,), (), 0.5),)),
        (NAMES, (dataclasses.replace(POINT, time_from_start=0.0),)),
        (NAMES, (dataclasses.replace(POINT, time_from_start=-0.5),)),
    ],
)
def test_command_form(
    bench: Bench, names: tuple[str, ...], points: tuple[CommandPoint, ...]
) -> None:
    bench.ready()
    bench.supervisor.submit(Command(bench.ros_ns, names, points), bench.now)
    refused(bench, Rule.COMMAND_FORM)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["insertion", "rotation", "others", "time"])
def test_command_finite(bench: Bench, bad: float, where: str) -> None:
    bench.ready()
    point = CommandPoint(
        (bad if where == "insertion" else 0.001, bad if where == "rotation" else 0.1),
        (bad,) if where == "others" else (0.0,),
        bad if where == "time" else 0.5,
    )
    bench.supervisor.submit(Command(bench.ros_ns, NAMES, (point,)), bench.now)
    refused(bench, Rule.COMMAND_FINITE)


def test_command_joints_may_come_in_any_order(bench: Bench) -> None:
    bench.ready()
    point = CommandPoint((0.1, 0.001), (), 0.5)
    bench.supervisor.submit(Command(bench.ros_ns, NAMES[::-1], (point,)), bench.now)
    bench.cycle(25, holding=True)
    assert bench.positions == (0.001, 0.1)


@pytest.mark.parametrize("older_by_ns", [0, 1])
def test_command_newer_than_the_last(bench: Bench, older_by_ns: int) -> None:
    bench.ready()
    stamp = bench.command()
    bench.cycle(25, holding=True)
    bench.command(stamp_ns=stamp - older_by_ns)
    assert bench.last_rule is Rule.COMMAND_NEWER
    assert in_state(bench, State.HOLDING)


def test_tip_age_on_the_steady_clock_while_ros_time_stands_still(bench: Bench) -> None:
    bench.ready()
    stamp = bench.ros_ns
    bench.now += bench.limits.tip_age_limit + 0.1
    bench.hold(False)
    bench.hold()
    bench.supervisor.note_time(stamp, bench.now)
    bench.supervisor.observe(bench.now)
    bench.command(stamp_ns=stamp)
    assert "old" in refused(bench, Rule.TIP_AGE)
    assert bench.status.watchdog_trips == 1


def test_tip_age_counts_steady_seconds_while_ros_time_runs_fast(bench: Bench) -> None:
    bench.ready()
    stamp = bench.ros_ns
    for _ in range(100):
        bench.ros_ns += 1_000_000_000
        bench.now += 0.001
        bench.supervisor.note_time(bench.ros_ns, bench.now)
    bench.supervisor.observe(bench.now)
    bench.command(stamp_ns=stamp)
    assert in_state(bench, State.MOVING)


@pytest.mark.parametrize("offset_ns", [-1_000_000_000, 200_000_000])
def test_tip_age_unknown_or_from_the_future(bench: Bench, offset_ns: int) -> None:
    bench.ready()
    bench.command(stamp_ns=bench.ros_ns + offset_ns)
    refused(bench, Rule.TIP_AGE)


def test_homed_first(bench: Bench) -> None:
    bench.supervisor.configure(bench.now)
    bench.supervisor.enable(True, bench.now)
    bench.hold()
    bench.command()
    refused(bench, Rule.HOMED_FIRST)


@pytest.mark.parametrize("length", [0.0, -0.001])
def test_forward_only(bench: Bench, length: float) -> None:
    bench.ready()
    bench.command(length)
    refused(bench, Rule.FORWARD_ONLY)


def test_max_depth(make_bench: Any) -> None:
    bench = make_bench(max_depth=0.0015)
    bench.ready()
    bench.command(0.0016)
    refused(bench, Rule.MAX_DEPTH)
    bench.command(0.0015)
    assert in_state(bench, State.MOVING)


def test_max_step_length_also_in_the_wrong_unit(bench: Bench) -> None:
    bench.ready()
    bench.command(0.00201, duration=1.0)
    assert "2.01 mm is beyond 2 mm" in refused(bench, Rule.MAX_STEP_LENGTH)
    bench.command(1.0, duration=1.0)
    refused(bench, Rule.MAX_DEPTH)


def test_max_speed_of_5_mm_a_second_is_a_hard_cap(bench: Bench) -> None:
    bench.ready()
    bench.command(0.001, duration=0.199)
    refused(bench, Rule.MAX_SPEED)
    with pytest.raises(OutOfBoundsError, match="max_speed"):
        SafetyLimits(max_speed=0.0051)


def test_max_rotation_step(bench: Bench) -> None:
    bench.ready()
    bench.command(0.001, -1.21)
    refused(bench, Rule.MAX_ROTATION_STEP)


def test_max_rotation_rate(bench: Bench) -> None:
    bench.ready()
    bench.command(0.001, 1.0, duration=0.31)
    refused(bench, Rule.MAX_ROTATION_RATE)


def test_max_turns(make_bench: Any) -> None:
    bench = make_bench(max_turns=0.1)
    bench.ready()
    bench.command(0.001, -0.63)
    refused(bench, Rule.MAX_TURNS)
    bench.command(0.001, -0.62)
    assert in_state(bench, State.MOVING)


# ---- motion -----------------------------------------------------------------------------------


def test_coordinated_in_proportion_whatever_the_speed(bench: Bench) -> None:
    bench.ready()
    bench.command(0.001, -0.5)
    for scale in (1.0, 0.2, 0.7, 0.0, 0.05, 1.0, 0.5):
        bench.cycle(3, holding=True, scale=scale)
        insertion, rotation = bench.positions
        assert rotation == pytest.approx(insertion / 0.001 * -0.5, rel=1e-12)
    bench.cycle(25, holding=True)
    assert bench.positions == (0.001, -0.5)


@pytest.mark.parametrize("which", ["insertion", "rotation"])
def test_following_error_of_one_axis_stops_both(bench: Bench, which: str) -> None:
    bench.ready()
    getattr(bench, which).stuck = True
    bench.command(0.002, 1.0, duration=0.5)
    bench.cycle(25, holding=True)
    assert bench.last_rule is Rule.FOLLOWING_ERROR
    assert in_state(bench, State.FAULT)
    assert which in bench.status.fault
    assert abs(bench.insertion.position) <= bench.limits.insertion_following_error + 1e-4
    assert bench.insertion.stops == bench.rotation.stops == 1


def inserted(bench: Bench, steps: int = 3) -> None:
    bench.ready()
    for _ in range(steps):
        bench.cycle(1, holding=True)
        bench.command(0.001, 0.2)
        bench.cycle(25, holding=True)


def test_retraction_moves_insertion_only_slowly_and_with_the_hold(bench: Bench) -> None:
    inserted(bench)
    bench.hold(False)
    assert not bench.supervisor.retract(bench.now).success
    bench.hold()
    rotation = bench.rotation.position
    bench.rotation.orders.clear()
    assert bench.supervisor.retract(bench.now).success
    start = bench.now, bench.insertion.position
    bench.cycle(10, holding=True)
    speed = (start[1] - bench.insertion.position) / (bench.now - start[0])
    assert speed == pytest.approx(bench.limits.retraction_speed)
    bench.hold(False)
    at = bench.insertion.position
    bench.cycle(5)
    assert bench.insertion.position == at
    bench.hold()
    assert bench.supervisor.retract(bench.now).success
    bench.cycle(100, holding=True)
    assert bench.positions == (0.0, rotation)
    assert "move" not in bench.rotation.orders
    assert in_state(bench, State.HOLDING)
    assert [r.outcome for r in bench.results] == ["succeeded"] * 3


def rebooted(bench: Bench) -> None:
    """Let the insertion drive lose its home at 3 mm depth; it counts from 0 again."""
    inserted(bench)
    bench.insertion.homed = False
    bench.insertion.switch = False
    bench.insertion.position, bench.insertion.target = 0.0, None
    bench.cycle(1, holding=True)


def test_unhomed_outward_only_by_the_last_known_depth(bench: Bench) -> None:
    rebooted(bench)
    assert not bench.status.homed
    bench.cycle(1, holding=True)
    bench.command(0.001)
    assert bench.last_rule is Rule.HOMED_FIRST
    assert bench.supervisor.retract(bench.now).success
    bench.cycle(200, holding=True)
    assert bench.insertion.position == pytest.approx(-0.003)
    assert in_state(bench, State.HOLDING)
    assert "out" in bench.supervisor.retract(bench.now).message


def test_unhomed_outward_only_ends_at_the_switch(bench: Bench) -> None:
    rebooted(bench)
    assert bench.supervisor.retract(bench.now).success
    bench.cycle(10, holding=True)
    bench.insertion.switch = True
    bench.cycle(1, holding=True)
    assert in_state(bench, State.HOLDING)
    at = bench.insertion.position
    bench.cycle(10, holding=True)
    assert bench.insertion.position == at


def test_homing_needle_out_must_be_confirmed_and_a_step_ends_that(bench: Bench) -> None:
    bench.supervisor.configure(bench.now)
    assert "confirm" in bench.supervisor.home(bench.now).message
    inserted(bench, steps=0)
    assert bench.status.needle_out_confirmed
    bench.cycle(1, holding=True)
    bench.command()
    bench.cycle(25, holding=True)
    assert not bench.status.needle_out_confirmed
    bench.supervisor.enable(False, bench.now)
    assert not bench.supervisor.home(bench.now).success


def test_homing_needle_out_only_when_disabled_and_can_be_stopped(bench: Bench) -> None:
    bench.insertion.position = 0.01
    bench.home()
    assert bench.supervisor.activity is Activity.HOMING
    assert not bench.supervisor.confirm_needle_out(False).success
    bench.cycle(5)
    at = bench.positions
    bench.supervisor.stop()
    bench.cycle(5)
    assert bench.positions == at
    assert in_state(bench, State.DISABLED)
    assert not bench.insertion.powered
    assert bench.supervisor.home(bench.now).success
    bench.cycle(500)
    assert bench.positions == (0.0, 0.0)
    assert bench.status.homed
    assert in_state(bench, State.DISABLED)
    bench.supervisor.enable(True, bench.now)
    assert not bench.supervisor.home(bench.now).success


def test_homing_time_is_bounded(make_bench: Any) -> None:
    bench = make_bench(max_depth=0.002, max_turns=0.1)
    bench.insertion.position = 0.001
    bench.insertion.stuck = True
    bench.home()
    bench.cycle(100)
    assert in_state(bench, State.FAULT)
    assert bench.last_rule is Rule.HOMING_TIME


# ---- stops ------------------------------------------------------------------------------------


def test_estop_latches_until_released_hold_off_and_reset(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(3, holding=True)
    at = bench.positions
    bench.supervisor.receive_estop(True)
    assert in_state(bench, State.ESTOPPED)
    assert bench.insertion.stops == bench.rotation.stops == 1
    assert bench.results[-1].outcome == "aborted: emergency stop"
    assert bench.last_rule is Rule.ESTOP_LATCHES
    bench.cycle(1, holding=True)
    assert "still pressed" in bench.supervisor.reset(bench.now).message
    bench.supervisor.receive_estop(False)
    assert in_state(bench, State.ESTOPPED)
    assert not bench.supervisor.enable(True, bench.now).success
    assert "hold" in bench.supervisor.reset(bench.now).message
    bench.hold(False)
    assert bench.supervisor.reset(bench.now).success
    assert in_state(bench, State.DISABLED)
    bench.cycle(20, holding=True)
    assert bench.positions == at


@pytest.mark.parametrize("state", ["UNCONFIGURED", "DISABLED", "HOLDING", "FAULT"])
def test_estop_latches_from_every_state(bench: Bench, state: str) -> None:
    if state != "UNCONFIGURED":
        bench.home()
    if state == "HOLDING":
        bench.supervisor.enable(True, bench.now)
    if state == "FAULT":
        bench.supervisor.fail("test")
    assert bench.state.value == state
    bench.supervisor.receive_estop(True)
    bench.supervisor.receive_estop(True)
    assert in_state(bench, State.ESTOPPED)
    bench.supervisor.receive_estop(False)
    assert bench.supervisor.reset(bench.now).success
    wanted = State.UNCONFIGURED if state == "UNCONFIGURED" else State.DISABLED
    assert in_state(bench, wanted)


@pytest.mark.parametrize("which", ["insertion", "rotation"])
@pytest.mark.parametrize("how", ["fault", "power", "home", "unplugged"])
def test_one_fault_stops_both(bench: Bench, which: str, how: str) -> None:
    bench.ready()
    bench.command()
    bench.cycle(5, holding=True)
    axis = getattr(bench, which)
    other = bench.rotation if axis is bench.insertion else bench.insertion
    if how == "fault":
        axis.fault = "overcurrent"
    elif how == "power":
        axis.powered = False
    elif how == "home":
        axis.homed = False
    else:
        axis.unplugged = True
    before = other.position
    bench.cycle(1, holding=True)
    assert in_state(bench, State.FAULT)
    assert bench.last_rule is Rule.ONE_FAULT_STOPS_BOTH
    assert bench.results[-1].outcome.startswith("aborted: ")
    assert other.stops == 1
    # What was ordered before the fault showed: one period at most.
    at = other.position
    assert abs(at - before) <= 0.1 * bench.period / 0.5 + 1e-9
    bench.cycle(10, holding=True)
    assert other.position == at


def test_reply_age_a_silent_axis_is_a_fault_and_hides_the_joints(bench: Bench) -> None:
    bench.ready()
    bench.command(0.002, 0.1, duration=2.0)
    bench.cycle(5, holding=True)
    bench.rotation.silent_since = bench.now
    silent = bench.now
    while in_state(bench, State.MOVING):
        bench.cycle(1, holding=True)
    assert bench.now - silent <= bench.limits.reply_age_limit + 2 * bench.period
    assert bench.last_rule is Rule.REPLY_AGE
    assert bench.supervisor.joints(bench.now) is None
    assert bench.status.insertion is None
    bench.hold(False)
    assert not bench.supervisor.reset(bench.now).success
    bench.rotation.silent_since = None
    assert bench.supervisor.reset(bench.now).success


def test_disable_stop_and_close_end_a_motion(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(2, holding=True)
    assert bench.supervisor.enable(False, bench.now).success
    assert in_state(bench, State.DISABLED)
    assert not bench.insertion.powered
    assert bench.results[-1].outcome == "aborted: disabled on request"
    bench.supervisor.enable(True, bench.now)
    bench.hold(False)
    bench.hold()
    bench.command(stamp_ns=bench.ros_ns)
    bench.supervisor.close()
    assert bench.results[-1].outcome == "aborted: the device is shut down"


def test_configuration_that_fails_is_a_fault_with_the_reason(bench: Bench) -> None:
    bench.insertion.unplugged = True
    assert not bench.supervisor.configure(bench.now).success
    assert in_state(bench, State.FAULT)
    assert "no link" in bench.status.fault
    assert bench.supervisor.reset(bench.now).success
    assert in_state(bench, State.UNCONFIGURED)


def test_a_command_at_its_limits_passes(bench: Bench) -> None:
    bench.ready()
    bench.supervisor.submit(bench.step_command(0.002, 1.2, bench.ros_ns, 0.4), bench.now)
    assert in_state(bench, State.MOVING)
