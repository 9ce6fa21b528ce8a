"""An axis on drives that answer requests: homing, steps, stops and faults."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from .ideal_protocol import Drive, PolledBench

# Counts of a millimetre.
MM = 20_000


def test_homing_finds_the_edge_of_the_switch_and_writes_the_limits() -> None:
    bench = PolledBench().ready()
    # The axis leaves the switch at 0.2 mm/s, 4 um per cycle.
    assert 0 <= bench.insertion.position - bench.insertion.edge <= 0.004 * MM
    lower, upper = bench.protocol.limits["insertion"]
    assert (upper - lower) / MM == pytest.approx(202.0, abs=0.01)
    assert bench.status.insertion_m == pytest.approx(0.0, abs=1e-9)


def test_homing_without_a_switch_ends() -> None:
    bench = PolledBench(max_depth=0.002)
    bench.insertion.edge = -(10**9)
    assert bench.configure().success
    bench.wait(2)
    assert bench.home().success
    bench.wait(300)
    assert bench.state == "FAULT"
    assert bench.rule == "homing_time"
    assert abs(bench.insertion.position) < 2.5 * MM


def test_step_moves_both_axes_in_proportion_and_a_release_stops_them() -> None:
    bench = PolledBench().ready()
    before = bench.insertion.position
    bench.step()
    bench.go(40)
    assert bench.outcomes == ["succeeded"]
    assert bench.insertion.position - before == pytest.approx(1.0 * MM, abs=1)
    bench.step()
    bench.go(10)
    bench.hold(False)
    bench.wait(2)
    place = bench.insertion.position
    bench.wait(30)
    assert bench.insertion.position == place
    assert bench.outcomes[-1] == "aborted: hold released"
    bench.press()
    bench.step()
    bench.go(40)
    assert bench.outcomes[-1] == "succeeded"


def test_late_answers_slow_a_step_down() -> None:
    bench = PolledBench().ready()
    bench.protocol.is_late = True
    bench.step()
    bench.go(40)
    assert bench.activity == "step"
    bench.go(40)
    assert bench.outcomes == ["succeeded"]
    assert bench.drives.health("").message.endswith("cycles had no answer in time")


def test_each_set_point_is_ordered_once() -> None:
    bench = PolledBench().ready()
    orders: list[int] = []
    move_to = bench.protocol.move_to

    def record(axis: str, position: int, speed: int) -> None:
        orders.append(position)
        move_to(axis, position, speed)

    bench.protocol.move_to = record  # type: ignore[method-assign]
    bench.step(0.001, 0.0, 0.21)
    bench.go(40)
    # The supervisor repeats the last set-point until the axes are at rest.
    assert bench.outcomes == ["succeeded"]
    assert len(orders) == len(set(orders)) == 11


def test_a_blocked_axis_is_released_when_it_is_stopped() -> None:
    bench = PolledBench().ready()
    bench.step(0.002, 0.2, 0.4)
    bench.go(2)
    bench.insertion.blocked = True
    bench.go(3)
    bench.hold(False)
    bench.wait(5)
    bench.insertion.blocked = False
    place = bench.insertion.position
    bench.wait(10)
    assert not bench.insertion.powered
    assert bench.insertion.position == place
    assert bench.state == "HOLDING"
    bench.press()
    bench.step()
    bench.go(60)
    assert bench.outcomes[-1] == "succeeded"


def _restart(bench: PolledBench, drive: Drive) -> None:
    drive.rebooted, drive.powered, drive.position = True, False, 0


def _silence(bench: PolledBench, _: Drive) -> None:
    bench.protocol.is_silent = True


def _unplug(bench: PolledBench, _: Drive) -> None:
    bench.link.set_port_error("unplugged")


def _set(name: str, value: object) -> Callable[[PolledBench, Drive], None]:
    return lambda _, drive: setattr(drive, name, value)


@pytest.mark.parametrize(
    ("event", "rule"),
    [
        (_restart, "drive_reboot"),
        (_silence, "reply_age"),
        (_unplug, "link_loss"),
        (_set("fault", "is too hot"), "drive_emergency"),
        (_set("blocked", True), "following_error"),
        (_set("powered", False), "one_fault_stops_both"),
    ],
)
def test_faults_of_a_moving_drive(event: Callable[[PolledBench, Drive], None], rule: str) -> None:
    bench = PolledBench().ready()
    bench.step(0.002, 0.2, 1.0)
    bench.go(10)
    event(bench, bench.insertion)
    bench.go(30)
    assert bench.state == "FAULT"
    assert rule in [notice.rule.value for notice in bench.notices if notice.rule]
    places = bench.insertion.position, bench.rotation.position
    bench.go(10)
    assert (bench.insertion.position, bench.rotation.position) == places
    bench.protocol.is_silent, bench.insertion.blocked = False, False
    bench.link.set_port_error("")
    bench.hold(False)
    result = bench.reset()
    assert result.success, result.message
    bench.wait(10)
    assert bench.state == "DISABLED"
    assert bench.is_homed() is (rule != "drive_reboot")


def test_motion_and_power_by_another_program_are_faults() -> None:
    bench = PolledBench().ready()
    bench.wait(40)
    bench.insertion.target += MM
    bench.go(2)
    assert (bench.state, bench.rule) == ("FAULT", "one_master")
    bench.hold(False)
    bench.wait(10)
    assert bench.reset().success
    bench.wait(10)
    bench.rotation.powered = True
    bench.wait(2)
    assert (bench.state, bench.rule) == ("FAULT", "one_master")


def test_a_drive_that_ignores_a_stop_is_named() -> None:
    bench = PolledBench().ready()
    bench.step(0.002, 0.2, 1.0)
    bench.go(10)
    bench.insertion.deaf = True
    bench.supervisor.receive_estop(True)
    bench.wait(100)
    assert "insertion axis still powered" in bench.status.fault


def test_set_points_are_bounded() -> None:
    bench = PolledBench().ready()
    axis = bench.drives.axes["insertion"]
    with pytest.raises(Exception, match="outside the limits"):
        axis.start_move(0.3, 0.005)
    with pytest.raises(Exception, match=r"set-point step of 0.0002.* limit"):
        axis.start_move(0.0002, 0.005)
