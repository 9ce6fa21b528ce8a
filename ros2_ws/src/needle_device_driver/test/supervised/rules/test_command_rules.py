"""Which commands are refused, named as in docs/safety.md."""

from __future__ import annotations

import dataclasses
import math

import pytest

from needle_core.errors import OutOfBoundsError
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.command import Command, CommandPoint
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.states import State

from ..checks import in_state, refused
from ..ideal_axes import Bench

NAMES = ("insertion_joint", "rotation_joint")
POINT = CommandPoint((0.001, 0.1), (), 0.5)


def test_command_state_only_in_holding(make_bench: type[Bench]) -> None:
    bench = make_bench()
    bench.home()
    bench.command()
    assert bench.last_rule is Rule.COMMAND_STATE
    assert "DISABLED" in bench.results[-1].outcome


def test_command_state_not_before_both_axes_are_powered(bench: Bench) -> None:
    bench.ready()
    bench.rotation.powered = False
    bench.command()
    assert bench.last_rule is Rule.COMMAND_STATE
    assert "not powered yet" in bench.results[-1].outcome
    assert in_state(bench, State.HOLDING)


@pytest.mark.parametrize("which", ["insertion", "rotation"])
def test_reply_age_no_step_begins_where_an_axis_is_silent(bench: Bench, which: str) -> None:
    bench.ready()
    getattr(bench, which).silent_since = bench.now - 0.101
    bench.command()
    assert bench.last_rule is Rule.REPLY_AGE
    assert in_state(bench, State.HOLDING)


def test_inner_limit_switch_no_step_begins_there(bench: Bench) -> None:
    bench.ready()
    bench.insertion.inner_switch = True
    bench.command()
    assert bench.last_rule is Rule.INNER_LIMIT_SWITCH
    assert in_state(bench, State.HOLDING)


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


@pytest.mark.parametrize(
    ("names", "points"),
    [
        ((), (POINT,)),
        (("insertion_joint",), (CommandPoint((0.001,), (), 0.5),)),
        (("insertion_joint", "roll"), (POINT,)),
        (("insertion_joint", "insertion_joint"), (POINT,)),
        ((*NAMES, "more"), (CommandPoint((0.001, 0.1, 0.0), (), 0.5),)),
        ((*NAMES, NAMES[0]), (CommandPoint((0.001, 0.1, 0.001), (), 0.5),)),
        (NAMES, ()),
        (NAMES, (POINT, POINT)),
        (NAMES, (CommandPoint((0.001,), (), 0.5),)),
        (NAMES, (dataclasses.replace(POINT, time_from_start=0.0),)),
        (NAMES, (dataclasses.replace(POINT, time_from_start=-0.5),)),
        (NAMES, (dataclasses.replace(POINT, time_from_start=600.1),)),
        (NAMES, (dataclasses.replace(POINT, time_from_start=2147483647.0),)),
    ],
)
def test_command_form(
    bench: Bench, names: tuple[str, ...], points: tuple[CommandPoint, ...]
) -> None:
    bench.ready()
    bench.supervisor.submit(Command(bench.ros_ns, names, points), bench.now)
    refused(bench, Rule.COMMAND_FORM)


def test_command_form_what_others_call_their_joints_is_told_in_short(bench: Bench) -> None:
    bench.ready()
    names = tuple("joint\n" * 100_000 for _ in range(300))
    bench.supervisor.submit(Command(bench.ros_ns, names, (POINT,)), bench.now)
    reason = refused(bench, Rule.COMMAND_FORM)
    assert len(reason) < 500
    assert reason.isprintable()
    assert "and 296 more" in reason


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


def test_command_newer_a_reset_keeps_no_stamp_out_that_would_have_counted(bench: Bench) -> None:
    bench.ready()
    bench.command()
    bench.cycle(25, holding=True)
    assert bench.run(bench.supervisor.reset(bench.now)).success
    bench.hold(False)
    bench.hold()
    bench.command(stamp_ns=bench.ros_ns - 40_000_000)
    assert in_state(bench, State.MOVING)


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


def test_tip_age_tells_how_far_a_clock_is_ahead(bench: Bench) -> None:
    bench.ready()
    bench.command(stamp_ns=bench.ros_ns + 200_000_000)
    why = refused(bench, Rule.TIP_AGE)
    assert "the tip is from the future: its stamp is 0.200 s ahead of this computer's clock" in why


def test_homed_first(bench: Bench) -> None:
    bench.run(bench.supervisor.configure(bench.now))
    bench.supervisor.enable(True, bench.now)
    bench.hold()
    bench.command()
    refused(bench, Rule.HOMED_FIRST)


@pytest.mark.parametrize("length", [0.0, -0.001])
def test_forward_only(bench: Bench, length: float) -> None:
    bench.ready()
    bench.command(length)
    refused(bench, Rule.FORWARD_ONLY)


def test_max_depth(make_bench: type[Bench]) -> None:
    bench = make_bench(max_depth=0.0015)
    bench.ready()
    bench.command(0.00151)
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


def test_max_speed_takes_a_step_at_the_bound_whatever_its_time_is_rounded_to(bench: Bench) -> None:
    bench.ready()
    # A nanosecond less than the way takes at 5 mm/s, as a message has it.
    bench.command(0.0003, duration=0.059_999_999)
    assert bench.state is State.MOVING


def test_max_rotation_step(bench: Bench) -> None:
    bench.ready()
    bench.command(0.001, -1.21)
    refused(bench, Rule.MAX_ROTATION_STEP)


def test_max_rotation_step_counts_from_where_the_rotation_is(bench: Bench) -> None:
    bench.ready()
    bench.command(0.001, 1.0)
    bench.cycle(25, holding=True)
    bench.command(0.001, -1.21)
    assert bench.last_rule is Rule.MAX_ROTATION_STEP
    bench.command(0.001, 1.0)
    assert in_state(bench, State.MOVING)


def test_max_rotation_rate(bench: Bench) -> None:
    bench.ready()
    bench.command(0.001, 1.0, duration=0.31)
    refused(bench, Rule.MAX_ROTATION_RATE)


def test_max_turns(make_bench: type[Bench]) -> None:
    bench = make_bench(max_turns=0.1)
    bench.ready()
    bench.command(0.001, -0.63)
    refused(bench, Rule.MAX_TURNS)
    bench.command(0.001, -0.62)
    assert in_state(bench, State.MOVING)


def test_a_command_at_its_limits_passes(bench: Bench) -> None:
    bench.ready()
    bench.supervisor.submit(bench.step_command(0.002, 1.2, bench.ros_ns, 0.4), bench.now)
    assert in_state(bench, State.MOVING)
