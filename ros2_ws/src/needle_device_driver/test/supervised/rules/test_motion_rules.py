"""Steps, retraction and homing, named as in docs/safety.md."""

from __future__ import annotations

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import Activity, State

from ..checks import in_state
from ..ideal_axes import Bench


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


@pytest.mark.parametrize(("which", "bound"), [("insertion", 0.0005), ("rotation", 0.1)])
@pytest.mark.parametrize("share", [0.99, 1.01])
def test_following_error_counts_from_its_bound_on(
    bench: Bench, which: str, bound: float, share: float
) -> None:
    bench.ready()
    bench.command()
    bench.cycle(5, holding=True)
    axis = getattr(bench, which)
    axis.position -= share * bound
    bench.now += bench.period
    bench.hold()
    bench.supervisor.drive(bench.period, bench.now)
    assert in_state(bench, State.FAULT if share > 1.0 else State.MOVING)


def test_retraction_waits_for_power(bench: Bench) -> None:
    inserted(bench)
    bench.insertion.powered = False
    assert "not powered yet" in bench.supervisor.retract(bench.now).message
    assert in_state(bench, State.HOLDING)


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


def test_unhomed_outward_only_not_from_the_switch(bench: Bench) -> None:
    rebooted(bench)
    bench.insertion.switch = True
    assert "out" in bench.supervisor.retract(bench.now).message
    assert in_state(bench, State.HOLDING)


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
    bench.run(bench.supervisor.configure(bench.now))
    assert "confirm" in bench.run(bench.supervisor.home(bench.now)).message
    inserted(bench, steps=0)
    assert bool(bench.status.needle_out_confirmed)
    bench.cycle(1, holding=True)
    bench.command()
    bench.cycle(25, holding=True)
    assert not bench.status.needle_out_confirmed
    bench.supervisor.enable(False, bench.now)
    assert not bench.run(bench.supervisor.home(bench.now)).success


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
    assert bench.run(bench.supervisor.home(bench.now)).success
    bench.cycle(500)
    assert bench.positions == (0.0, 0.0)
    assert bench.status.homed
    assert in_state(bench, State.DISABLED)
    bench.supervisor.enable(True, bench.now)
    assert not bench.run(bench.supervisor.home(bench.now)).success


@pytest.mark.parametrize(
    ("which", "longest"), [("insertion", 1.5 * 0.002 / 0.002), ("rotation", 1.5 * 0.6283 / 1.0)]
)
def test_homing_time_is_bounded_by_each_axis_own_travel(
    make_bench: type[Bench], which: str, longest: float
) -> None:
    # The other axis has a long way, and may take its time.
    bench = make_bench(
        max_depth=0.002 if which == "insertion" else 0.2,
        max_turns=0.1 if which == "rotation" else 10.0,
    )
    axis = getattr(bench, which)
    axis.position = 0.001
    axis.stuck = True
    bench.home()
    start = bench.now
    while in_state(bench, State.MOVING):
        assert bench.now - start < 10.0
        bench.cycle(1)
    assert bench.now - start == pytest.approx(longest, abs=2.1 * bench.period)
    assert in_state(bench, State.FAULT)
    assert bench.last_rule is Rule.HOMING_TIME
    assert f"no home switch of the {which} axis in" in bench.status.fault


def test_homing_time_on_the_switch_counts_a_quarter(make_bench: type[Bench]) -> None:
    bench = make_bench(max_depth=0.002, max_turns=0.1)
    bench.insertion.position, bench.insertion.switch = 0.001, True
    bench.insertion.stuck = True
    bench.home()
    bench.cycle(290)
    assert in_state(bench, State.MOVING)
    bench.cycle(20)
    assert in_state(bench, State.FAULT)
