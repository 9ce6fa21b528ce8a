"""Rules for steps, retraction and homing, named as in docs/safety.md."""

from __future__ import annotations

import math

import pytest

from ..ideal_axes import Bench
from ..supervisor_bench import PERIOD, accepted, rejected


def test_coordinated_joints_are_in_proportion_at_any_speed() -> None:
    bench = Bench().ready()
    stamp = bench.step(0.001, -0.5)
    for scale in (1.0, 0.2, 0.7, 0.0, 0.05, 1.0, 0.5):
        bench.go(3, scale)
        insertion, rotation = bench.positions
        assert rotation == pytest.approx(insertion / 0.001 * -0.5, rel=1e-12)
    # 25 periods are the whole step: 14.65 are left.
    bench.go(14)
    assert (bench.results, bench.state) == ([], "MOVING")
    assert bench.status.command_ns == stamp
    bench.go()
    assert bench.positions == (0.001, -0.5)
    assert (bench.status.insertion_m, bench.status.rotation_rad) == bench.positions
    assert (bench.status.reason, bench.status.text) == ("", "HOLDING")
    assert (bench.results, bench.state) == ([(stamp, "succeeded")], "HOLDING")


@pytest.mark.parametrize(("which", "bound"), [("insertion", 0.0005), ("rotation", 0.1)])
def test_following_error_bound_stops_both(which: str, bound: float) -> None:
    for share, state in ((0.999, "MOVING"), (1.002, "FAULT")):
        bench = Bench().moving()
        bench.axis(which).position -= share * bound
        bench.supervisor.drive(PERIOD, bench.now)
        assert bench.state == state, bench.status.fault
    assert bench.rule == "following_error"
    off, limit = {"insertion": ("0.501 mm", "0.5 mm"), "rotation": ("0.100 rad", "0.1 rad")}[which]
    assert bench.status.fault == f"the {which} axis is {off} off its set-point, limit {limit}"
    assert bench.insertion.orders[-2:] == bench.rotation.orders[-2:] == ["stop", "off"]


@pytest.mark.parametrize("which", ["insertion", "rotation"])
def test_settling_time_is_one_second(which: str) -> None:
    bench = Bench().ready()
    bench.step()
    bench.go(24)
    bench.axis(which).stuck = True
    bench.go(50)
    assert bench.state == "MOVING"
    bench.go(2)
    assert (bench.state, bench.rule) == ("FAULT", "settling_time")
    off = "0.0400 mm, rotation 0.00000" if which == "insertion" else "0.0000 mm, rotation 0.00400"
    assert bench.status.fault == (
        f"the axes are not at their target 1 s after the last set-point: insertion {off} rad off"
    )


# ---- retraction ---------------------------------------------------------------------------------


def inserted(*, homed: bool = True) -> Bench:
    """Return a device at a depth of 3 mm, with home, or without home and a new zero."""
    bench = Bench().ready()
    for _ in range(3):
        bench.go()
        bench.step(0.001, 0.2)
        bench.go(25)
    if not homed:
        bench.insertion.homed = bench.insertion.switch = False
        bench.insertion.position, bench.insertion.target = 0.0, math.nan
        bench.go(2)
    return bench


def test_retraction_is_slow_without_rotation_and_needs_the_hold() -> None:
    bench = inserted()
    bench.insertion.powered = False
    assert bench.retract() == rejected("the axes are not powered yet")
    bench.insertion.powered = True
    bench.hold(False)
    assert bench.retract() == rejected("press the hold first and keep it pressed")
    bench.hold()
    rotation = bench.rotation.position
    bench.rotation.orders.clear()
    assert bench.retract() == accepted("retracting 3.0 mm while the hold lasts")
    assert bench.retract() == rejected("the device is MOVING, not HOLDING")
    bench.go(10)
    bench.hold(False)
    bench.wait(5)
    assert bench.insertion.position == pytest.approx(0.003 - 10 * 0.002 * PERIOD)
    bench.hold()
    assert bench.retract().success
    bench.go(100)
    assert (bench.positions, bench.state) == ((0.0, rotation), "HOLDING")
    assert "move" not in bench.rotation.orders
    assert bench.retract() == accepted("the needle is out")


def test_retraction_ignores_inner_switch_and_rotation() -> None:
    bench = inserted()
    bench.insertion.inner_switch = True
    assert bench.retract().success
    bench.go()
    bench.rotation.position += 1.0
    bench.go(9)
    assert bench.status.activity == "retraction"
    bench.insertion.position += 0.00051
    bench.go()
    assert (bench.state, bench.rule) == ("FAULT", "following_error")


def test_unhomed_outward_only_by_the_last_known_depth() -> None:
    bench = inserted(homed=False)
    bench.step()
    assert bench.rule == "homed_first"
    assert bench.retract().success
    bench.go(40)
    # Only the remaining distance is allowed.
    bench.press()
    assert bench.retract() == accepted("retracting 1.4 mm while the hold lasts")
    bench.go(100)
    assert bench.insertion.position == pytest.approx(-0.003)
    assert bench.retract() == accepted("the needle is out")


def test_unhomed_outward_only_to_home_if_it_was_lost_beyond_it() -> None:
    bench = Bench().ready()
    bench.insertion.position = -0.0005
    bench.go()
    bench.insertion.homed = bench.insertion.switch = False
    bench.go()
    assert bench.retract() == accepted("the needle is out")
    bench.insertion.position = 0.001
    bench.go()
    assert bench.retract() == accepted("retracting 1.0 mm while the hold lasts")


def test_unhomed_outward_only_to_the_switch_or_by_max_depth() -> None:
    bench = inserted(homed=False)
    assert bench.retract().success
    bench.go(10)
    bench.insertion.switch = True
    bench.go()
    assert bench.state == "HOLDING"
    assert bench.retract() == accepted("the needle is out")
    bench = Bench(max_depth=0.1)
    bench.insertion.switch = False
    bench.configure()
    bench.enable()
    bench.hold()
    assert bench.retract() == accepted("retracting 100.0 mm while the hold lasts")


# ---- homing -------------------------------------------------------------------------------------


def test_homing_needle_out_needs_confirmation_until_the_next_step() -> None:
    bench = Bench()
    bench.configure()
    confirm = "confirm first that the needle is out (confirm_needle_out)"
    assert bench.run(bench.supervisor.home(bench.now)) == rejected(confirm)
    bench.ready()
    assert bench.home() == rejected("the device is HOLDING, not DISABLED")
    for length, is_out in ((-1.0, True), (0.001, False)):
        bench.step(length)
        assert bench.status.needle_out_confirmed is is_out, "one that is refused ends nothing"
    bench.enable(False)
    assert bench.run(bench.supervisor.home(bench.now)) == rejected(confirm)


def test_homing_needle_out_can_be_stopped() -> None:
    bench = Bench()
    bench.insertion.position = 0.01
    bench.configure()
    assert bench.home() == accepted("homing")
    assert bench.supervisor.may_move(bench.now), "without a hold"
    assert not bench.supervisor.confirm_needle_out(False).success
    bench.wait(5)
    assert bench.supervisor.stop() == accepted("homing stopped")
    bench.wait(5)
    assert bench.insertion.position == pytest.approx(0.01 - 5 * 0.002 * PERIOD)
    assert (bench.state, bench.insertion.powered) == ("DISABLED", False)
    assert bench.home().success
    bench.wait(300)
    assert (bench.positions, bench.state, bench.is_homed()) == ((0.0, 0.0), "DISABLED", True)
    assert bench.rotation.orders[-1] == "off"


@pytest.mark.parametrize(
    ("which", "longest"), [("insertion", 1.5 * 0.002 / 0.002), ("rotation", 1.5 * 0.62832 / 1.0)]
)
def test_homing_time_bound_of_each_axis(which: str, longest: float) -> None:
    # The other axis has a long travel; time at the switch counts a quarter.
    depth, turns = (0.002, 10.0) if which == "insertion" else (0.2, 0.1)
    for switch, factor in ((False, 1.0), (True, 4.0)):
        bench = Bench(max_depth=depth, max_turns=turns)
        axis = bench.axis(which)
        axis.position, axis.stuck, axis.switch = 0.001, True, switch
        bench.homed()
        bench.wait(math.floor(factor * longest / PERIOD) - 1)
        assert bench.state == "MOVING"
        bench.wait(3)
        assert (bench.state, bench.rule) == ("FAULT", "homing_time")
        text = f"the {which} axis did not find its home switch in {longest:.0f} s"
        assert bench.status.fault == text
