"""What a drive may be told to go to, named as in docs/safety.md."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import failed, in_state, recovers
from ..drive_bench import DriveBench
from ..ideal_axes import Bench

INSERTION, ROTATION = 1, 2


def test_look_ahead_is_one_cycle_at_every_moment(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.002, 1.2, 0.4)
    bound = 0.005 * 0.02 * 20e6
    for _ in range(25):
        before = bench.insertion.position
        bench.cycle(1, holding=True)
        assert bench.insertion.next_target - before <= bound * 1.02
    assert bench.outcomes == ["succeeded"]


@pytest.mark.parametrize("left_over", [-90, 90])
def test_look_ahead_counts_from_the_last_set_point_where_a_motor_rests_beside_it(
    make_drive_bench: Callable[..., DriveBench], left_over: int
) -> None:
    bench = make_drive_bench(retraction_speed=0.005)
    bench.ready()
    bench.insertion.left_over = left_over
    # As much as its tolerance has room for.
    bench.rotation.left_over = left_over // 10
    bench.cycle(1, holding=True)
    for number in (1, 2):
        # As far and as fast as may be, from where the last step was to end.
        target = Bench.step_command(0.002 * number, 1.1999 * number, bench.ros_ns, 0.4)
        bench.supervisor.submit(target, bench.clock())
        bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded", "succeeded"]
    assert bench.supervisor.retract(bench.clock()).success
    bench.cycle(60, holding=True)
    assert not in_state(bench, State.FAULT), bench.status.reason
    assert abs(bench.insertion.position) <= 100


def test_look_ahead_refuses_a_set_point_that_is_further(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    told = bench.axes[0].poll(0.0).set_point
    bench.axes[0].start_move(told + 0.0001, 0.005)
    # A cycle's way at 5 mm/s, 1 % and a count.
    with pytest.raises(Exception, match="ahead in a cycle") as caught:
        bench.axes[0].start_move(told + 0.0002012, 0.005)
    assert getattr(caught.value, "rule", None) is Rule.LOOK_AHEAD


def test_look_ahead_without_further_set_points_the_drive_ends_its_motion(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    last = bench.insertion.next_target
    for _ in range(10):
        # The computer is dead; something else still sends SYNC.
        bench.insertion.sync()
    assert bench.insertion.position == last


def test_look_ahead_an_axis_that_has_not_answered_is_not_sent_on(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.001, 1.0, 0.35)
    bench.cycle(3, holding=True)
    sync = bench.rotation.sync
    bench.rotation.sync = lambda: None  # type: ignore[method-assign]
    bench.cycle(1, holding=True)
    waiting = bench.insertion.next_target, bench.rotation.next_target
    bench.cycle(2, holding=True)
    assert (bench.insertion.next_target, bench.rotation.next_target) == waiting
    assert in_state(bench, State.MOVING)
    # It was but a moment.
    bench.rotation.sync = sync  # type: ignore[method-assign]
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]


def test_look_ahead_an_answer_that_comes_late_counts_in_the_next_cycle(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    # Half a cycle's way: a position that is a cycle too old would break it.
    bench = make_drive_bench(insertion_following_error=5e-5)
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.001, 0.1, 0.2)
    bench.bus.late = True
    for _ in range(20):
        bench.cycle(1, holding=True)
        bench.bus.flush()
    assert bench.outcomes == ["succeeded"]


def test_software_limits_in_the_drives_come_with_homing(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    for node in (INSERTION, ROTATION):
        assert bench.written(node, 0x607D, 1) == bytes.fromhex("00000080")
        assert bench.written(node, 0x607D, 2) == bytes.fromhex("ffffff7f")
    bench.supervisor.confirm_needle_out(True)
    bench.run(bench.supervisor.home(bench.clock()))
    bench.cycle(30)
    lower, upper = (
        int.from_bytes(bench.written(INSERTION, 0x607D, sub), "little", signed=True)
        for sub in (1, 2)
    )
    assert (lower, upper) == (-20_000, 4_020_000)


def test_software_limits_in_the_drives_end_while_they_are_homed_again(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.homed()
    assert bench.run(bench.supervisor.home(bench.clock())).success
    for node in (INSERTION, ROTATION):
        assert bench.written(node, 0x607D, 1) == bytes.fromhex("00000080")


@pytest.mark.parametrize("limit", ["00000080", "ffffff7f"], ids=["lower", "upper"])
def test_software_limits_that_a_drive_does_not_keep_refuse_the_drive(
    drive_bench: DriveBench, limit: str
) -> None:
    bench = drive_bench
    bench.insertion.stores = lambda index, value: (
        bytes(4) if index == 0x607D and value == bytes.fromhex(limit) else value
    )
    assert "and has 0" in bench.run(bench.supervisor.configure(bench.clock())).message


def test_software_limits_in_the_driver_refuse_a_set_point(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.ready()
    with pytest.raises(Exception, match="outside the drive's limits") as caught:
        bench.axes[0].start_move(0.3, 0.001)
    assert getattr(caught.value, "rule", None) is Rule.SOFTWARE_LIMITS


@pytest.mark.parametrize(("reverse", "at"), [(False, -(2**31)), (True, 2**31 - 1)])
def test_software_limits_of_an_axis_without_home_are_where_its_counter_ends(
    make_drive_bench: Callable[..., DriveBench], reverse: bool, at: int
) -> None:
    bench = make_drive_bench(insertion_reverse=reverse)
    drive = bench.insertion
    drive.position = drive.target = drive.next_target = at + (-5000 if reverse else 5000)
    bench.configured()
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(12)
    bench.hold(False)
    bench.hold()
    bench.cycle(1, holding=True)
    assert bench.supervisor.retract(bench.clock()).success
    bench.cycle(30, holding=True)
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is Rule.SOFTWARE_LIMITS
    assert "outside the drive's counter; home it, or set it nearer 0" in bench.status.fault
    assert abs(drive.position - at) < 1000


def test_following_error_of_a_blocked_motor(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.blocked = True
    for _ in range(20):
        bench.cycle(1, holding=True)
        if in_state(bench, State.FAULT):
            break
    failed(bench, Rule.FOLLOWING_ERROR, "mm off its set-point")
    assert bench.insertion.next_target - bench.insertion.position <= 0.7e-3 * 20e6
    at = bench.positions
    bench.insertion.blocked = False
    bench.cycle(10, holding=True)
    assert bench.positions == at, "a motor that comes free has no power to go on"
    recovers(bench)


def blocked_when_the_hold_is_let_go(bench: DriveBench) -> None:
    bench.moving()
    bench.insertion.blocked = True
    bench.cycle(3, holding=True)
    assert bench.insertion.demand > bench.insertion.position
    bench.hold(False)
    bench.cycle(8)
    assert bench.state is State.HOLDING


def test_following_error_of_a_motor_that_comes_free_after_the_stop(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    blocked_when_the_hold_is_let_go(bench)
    assert bench.insertion.state == "disabled"
    assert "insertion: blocked when it was stopped" in bench.status.reason
    at = bench.positions
    bench.insertion.blocked = False
    bench.cycle(10)
    assert bench.positions == at, "nobody holds"
    assert [n.rule for n in bench.notices if n.rule is Rule.FOLLOWING_ERROR] != []
    bench.hold()
    bench.step()
    bench.cycle(40, holding=True)
    assert bench.outcomes[-1] == "succeeded"


def test_following_error_that_a_drive_does_not_tell_is_told_at_the_set_up(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.insertion.missing_objects = {0x60F4}
    bench.insertion.place_size = 4
    blocked_when_the_hold_is_let_go(bench)
    assert bench.insertion.state == "quick stop", "it is where it was left, for all one knows"
    assert "no following error to map" in bench.drives.missing_optional_objects[0]


def test_following_error_that_a_drive_reports(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.STATES = {**bench.rotation.STATES, "enabled": 0x2237}
    bench.cycle(1, holding=True)
    failed(bench, Rule.FOLLOWING_ERROR, "the drive reports a following error")


def test_following_error_counts_from_the_set_point_that_was_due(
    make_drive_bench: Callable[..., DriveBench],
) -> None:
    # A cycle's way at full speed is twice this bound.
    bench = make_drive_bench(insertion_following_error=5e-5)
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.002, 0.3, 0.4)
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]


def test_settling_time_names_an_axis_that_does_not_arrive(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.cycle(30, holding=True)
    # 0.1 mm before the target, within the following error.
    bench.insertion.blocked = True
    bench.cycle(12, holding=True)
    bench.insertion.position = 38_000
    bench.cycle(45, holding=True)
    assert in_state(bench, State.MOVING)
    bench.cycle(20, holding=True)
    failed(bench, Rule.SETTLING_TIME, "insertion 0.1000 mm")


def test_no_motion_by_itself_set_up_enabling_and_reset_leave_a_drive_where_it_is(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    # Where the drive was left, with a set-point of someone else's.
    bench.insertion.position, bench.insertion.next_target = 12_345, 99_999
    bench.configured()
    bench.cycle(5)
    assert bench.insertion.position == 12_345
    # Someone turns the motor while it is off.
    bench.insertion.position = 55_555
    bench.cycle(1)
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(20)
    assert bench.insertion.state == "enabled"
    assert bench.insertion.position == 55_555
