"""Axes on scripted drives: set-points, homing, an axis without motor."""

from __future__ import annotations

import pytest

from .drive_bench import RAD, DriveBench


@pytest.mark.parametrize("reverse", [False, True])
def test_steps_add_up_without_rounding_errors(reverse: bool) -> None:
    bench = DriveBench(insertion_reverse=reverse).ready()
    insertion = rotation = 0.0
    for k in range(15):
        insertion += 0.0003 + 0.0004 * (k % 7) / 7
        rotation += 0.2 * (-1) ** (k // 3) * (k % 5) / 5
        bench.go()
        bench.submit((insertion, rotation, 0.15))
        bench.go(11)
    assert bench.outcomes == ["succeeded"] * 15
    sign = -1 if reverse else 1
    assert bench.positions == (sign * round(insertion * 20e6), round(rotation * RAD))
    assert bench.status.insertion_m == pytest.approx(insertion, abs=1e-7)
    assert bench.state == "HOLDING"


def test_velocity_is_measured_over_the_last_cycle() -> None:
    bench = DriveBench().moving()
    joints = bench.supervisor.joints(bench.now)
    assert joints is not None
    assert joints.insertion.velocity == pytest.approx(0.002)
    assert joints.rotation.velocity == pytest.approx(0.2, rel=2e-2)


def test_drive_without_transition_16_is_switched_off_and_on() -> None:
    bench = DriveBench().moving()
    bench.insertion.keeps_quick_stop = True
    bench.hold(False)
    bench.wait(5)
    bench.hold()
    bench.step()
    bench.go(60)
    assert bench.outcomes == ["aborted: hold released", "succeeded"]


def test_enable_and_home_wait_until_the_axes_are_off() -> None:
    bench = DriveBench().ready()
    bench.enable(False)
    for reply in (bench.enable(), bench.home()):
        assert reply.message == "waiting for the axes to switch off"
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
        assert bench.link.bus_errors == number
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


def test_stopped_homing_leaves_the_axis_without_home() -> None:
    bench = DriveBench()
    bench.insertion.home_after = 1000
    bench.homing()
    bench.wait(6)
    bench.supervisor.stop()
    assert bench.insertion.state == "quick stop"
    bench.wait(10)
    assert bench.insertion.state == bench.rotation.state == "disabled"
    assert (bench.is_homed(), bench.state) == (False, "DISABLED")


# ---- an insertion axis that a hand pushes -------------------------------------------------------


def pushed(home: int = 777) -> DriveBench:
    bench = DriveBench(insertion_drive="hand")
    bench.insertion.position = home
    return bench.ready()


@pytest.mark.parametrize("home", [777, -777])
def test_axis_without_motor_gets_no_motion_commands_and_no_watchdog(home: int) -> None:
    bench = pushed(home)
    assert bench.status.insertion_m == pytest.approx(0.0)
    bench.step(0.001, 0.2)
    bench.go()
    bench.insertion.position += 5000
    bench.go(3)
    assert bench.status.insertion_m == pytest.approx(0.00025)
    assert bench.rotation.next_target == pytest.approx(0.25 * 0.2 * RAD, abs=1)
    bench.hold(False)
    assert bench.rotation.state == "quick stop"
    assert bench.outcomes == ["aborted: hold released"]
    assert not [cob for cob, _ in bench.bus.sent if cob in (0x201, 0x301)]
    assert (0x605A, 0) not in bench.insertion.objects
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
