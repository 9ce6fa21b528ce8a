"""Axes on scripted drives: set-points, homing, an axis without motor."""

from __future__ import annotations

import pytest

from .drive_bench import RAD, DriveBench
from .supervisor_bench import rejected


@pytest.mark.parametrize(("reverse", "sign"), [(False, 1), (True, -1)])
def test_steps_add_up_without_rounding_errors(reverse: bool, sign: int) -> None:
    bench = DriveBench(insertion_reverse=reverse).ready()
    insertion = rotation = 0.0
    for k in range(15):
        insertion += 0.0003 + 0.0004 * (k % 7) / 7
        rotation += 0.2 * (-1) ** (k // 3) * (k % 5) / 5
        bench.go()
        bench.submit((insertion, rotation, 0.15))
        bench.go(11)
    assert bench.outcomes == ["succeeded"] * 15
    assert bench.positions == (sign * round(insertion * 20e6), round(rotation * RAD))
    assert bench.status.insertion_m == pytest.approx(insertion, abs=1e-7)


def test_velocity_is_measured_over_the_last_cycle() -> None:
    bench = DriveBench().moving()
    before = bench.axes[0].monitor.feedback.number
    bench.go(3)
    assert bench.axes[0].monitor.feedback.number == before + 3
    assert bench.axes[0].poll(bench.now).velocity == pytest.approx(0.002)
    assert bench.axes[1].poll(bench.now).velocity == pytest.approx(0.2, rel=2e-2)


def test_enable_and_home_wait_until_the_axes_are_off() -> None:
    bench = DriveBench().ready()
    bench.enable(False)
    for reply in (bench.enable(), bench.home()):
        assert reply == rejected("waiting for the axes to switch off")
    bench.wait(10)
    assert bench.enable().success


def test_outer_end_is_negative_limit_or_home_switch() -> None:
    for reverse, outer, inner in ((False, (1, 4, 5), (2,)), (True, (2, 4, 6), (1,))):
        bench = DriveBench(insertion_reverse=reverse).configured()
        for inputs in range(8):
            bench.insertion.inputs = inputs
            bench.wait()
            at = bench.axes[0].poll(bench.now)
            assert at.at_home_switch is any(inputs & bits for bits in outer)
            assert at.at_inner_switch is any(inputs & bits for bits in inner)


def test_frames_of_a_wrong_length_are_counted_and_change_nothing() -> None:
    bench = DriveBench().configured()
    for number, cob_id in enumerate((0x181, 0x281, 0x701, 0x081), 1):
        bench.bus.put(cob_id, b"\x01" * (cob_id != 0x701))
        assert bench.bus.bus_errors == number
    bench.wait(2)
    assert bench.state == "DISABLED"


# ---- homing -------------------------------------------------------------------------------------


def again(bench: DriveBench, position: int, home_after: int) -> DriveBench:
    """Begin to home a drive that reports the previous homing as attained."""
    bench.homed()
    drive = bench.insertion
    drive.position, drive.home_after, drive.stale_homing = position, home_after, True
    drive.more_status = 0x1400
    assert bench.home().success
    return bench


@pytest.mark.parametrize("under_way", [0x1000, 0x0400])
def test_homing_ends_when_home_is_attained_and_the_target_reached(under_way: int) -> None:
    bench = again(DriveBench(), 3000, 20)
    bench.wait(4)
    for _ in range(15):
        bench.insertion.more_status = under_way
        bench.wait()
        assert not bench.is_homed()
    bench.wait(20)
    assert (bench.is_homed(), bench.insertion.position) == (True, 0)


@pytest.mark.parametrize(("parameters", "cycles"), [({}, 25), ({"insertion_homing_method": 37}, 5)])
def test_homing_within_one_cycle_ends(parameters: dict[str, int], cycles: int) -> None:
    """At the edge of its switch a drive homes within one cycle."""
    bench = again(DriveBench(**parameters), 0, 0)
    stood = 0
    while not bench.is_homed():
        stood += bench.insertion.state == "enabled"
        bench.wait()
    assert stood == cycles


# ---- an insertion axis that a hand pushes -------------------------------------------------------


def test_axis_without_motor_gets_no_motion_commands_and_no_watchdog() -> None:
    bench = DriveBench(insertion_drive="hand")
    bench.insertion.position = 777
    bench.ready()
    assert bench.status.insertion_m == pytest.approx(0.0)
    bench.step(0.001, 0.2)
    bench.go()
    bench.insertion.position += 5000
    bench.go(3)
    assert bench.status.insertion_m == pytest.approx(0.00025)
    assert bench.rotation.next_target == pytest.approx(0.25 * 0.2 * RAD, abs=1)
    bench.hold(False)
    assert bench.rotation.state == "quick stop"
    assert not [cob for cob, _ in bench.bus.sent if cob in (0x201, 0x301)]
    assert bench.insertion.value(0x1016, 1) == 0
    # A fault of its drive is acknowledged by SDO.
    bench.after(lambda: bench.insertion.fail(0x7305))
    assert bench.state == "FAULT"
    bench.hold(False)
    bench.wait(8)
    assert bench.reset().success
    assert bench.insertion.state == "disabled"
    bench.run(bench.supervisor.deconfigure())
    assert bench.state == "UNCONFIGURED"
