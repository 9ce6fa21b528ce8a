"""Rules for set-points, named as in docs/safety.md."""

from __future__ import annotations

import math

import pytest

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.rules import Rule

from ..drive_bench import RAD, DriveBench


def refused(bench: DriveBench, target: float, rule: Rule, axis: int = 0) -> str:
    with pytest.raises(AxisError) as caught:
        bench.axes[axis].start_move(target, 0.005)
    assert caught.value.rule is rule
    return str(caught.value)


def test_look_ahead_refuses_a_farther_set_point() -> None:
    bench = DriveBench().moving()
    # One cycle at 5 mm/s, plus 1 % and a count.
    at, turned = bench.set_points
    why = "set-point step of 0.0001011 in a cycle at 0.005/s, limit 0.00010105"
    assert why in refused(bench, at + 2022 / 20e6, Rule.LOOK_AHEAD)
    bench.axes[0].start_move(at + 2021 / 20e6, 0.005)
    bench.axes[0].start_move(at, 0.005)
    largest_step = (math.pi * 0.02 * 1.01 * RAD) + 1
    refused(bench, turned + (largest_step + 1) / RAD, Rule.LOOK_AHEAD, 1)
    bench.axes[1].start_move(turned + (largest_step - 1) / RAD, 0.005)


def test_look_ahead_counts_from_the_last_set_point() -> None:
    bench = DriveBench(retraction_speed=0.005).ready()
    # The axes rest off their set-points, within the tolerance.
    bench.insertion.left_over, bench.rotation.left_over = 90, 9
    bench.go()
    for number in (1, 2):
        # The longest and fastest step, from the last set-point.
        bench.submit((0.002 * number, 1.1999 * number, 0.4))
        bench.go(30)
    assert bench.outcomes == ["succeeded", "succeeded"]
    assert bench.retract().success
    bench.go(60)
    assert bench.state != "FAULT", bench.status.reason
    assert abs(bench.insertion.position) <= 100


@pytest.mark.parametrize("late", [False, True])
def test_following_error_uses_the_set_point_of_the_answer(late: bool) -> None:
    # Half a cycle: a position that is one cycle too old would exceed the bound.
    bench = DriveBench(insertion_following_error=5e-5).ready()
    bench.step(0.001, 0.1, 0.2)
    bench.bus.late = late
    for _ in range(20):
        bench.go()
        bench.bus.flush()
    assert bench.outcomes == ["succeeded"]


def test_following_error_of_a_motor_released_after_the_stop() -> None:
    bench = DriveBench().moving()
    bench.insertion.blocked = True
    bench.go(3)
    bench.hold(False)
    bench.wait(8)
    assert (bench.state, bench.insertion.state) == ("HOLDING", "disabled")
    assert "insertion: blocked when it was stopped" in bench.status.reason
    assert [n.rule for n in bench.notices].count(Rule.FOLLOWING_ERROR) == 1
    bench.insertion.blocked = False
    bench.hold()
    bench.steps()


def test_following_error_reported_by_the_drive() -> None:
    bench = DriveBench().moving()
    bench.rotation.STATES = {**bench.rotation.STATES, "enabled": 0x2237}
    bench.go()
    bench.failed("following_error", "the drive reports a following error")


# ---- software limits ----------------------------------------------------------------------------


def test_software_limits_of_the_drives_follow_homing() -> None:
    bench = DriveBench().configured()

    def limits() -> list[int]:
        drives = bench.insertion, bench.rotation
        return [drive.value(0x607D, sub) for drive in drives for sub in (1, 2)]

    none = [-(2**31), 2**31 - 1] * 2
    assert limits() == none
    assert bench.home().success
    bench.wait(30)
    # -1 mm to 201 mm, 10 turns and 0.2 rad either way.
    assert limits() == [-20_000, 4_020_000, -657_446, 657_446]
    assert bench.home().success
    assert limits() == none


@pytest.mark.parametrize(("reverse", "at"), [(False, -(2**31)), (True, 2**31 - 1)])
def test_software_limits_without_home_are_the_counter_range(reverse: bool, at: int) -> None:
    bench = DriveBench(insertion_reverse=reverse)
    drive = bench.insertion
    drive.position = drive.target = drive.next_target = at + (-5000 if reverse else 5000)
    bench.configured()
    bench.enabled()
    assert bench.retract().success
    bench.go(30)
    assert (bench.state, bench.rule) == ("FAULT", "software_limits")
    assert "outside the drive's counter; home it, or set it nearer 0" in bench.status.fault
    assert abs(drive.position - at) < 1000


def test_no_motion_by_itself_on_set_up_enable_and_reset() -> None:
    bench = DriveBench()
    # The drive still holds a set-point from another program.
    bench.insertion.position, bench.insertion.next_target = 12_345, 99_999
    bench.configured()
    bench.wait(5)
    assert bench.insertion.position == 12_345
    # A person turns the motor while it is off.
    bench.insertion.position = 55_555
    bench.wait()
    assert bench.enable().success
    bench.wait(20)
    assert (bench.insertion.state, bench.insertion.position) == ("enabled", 55_555)
