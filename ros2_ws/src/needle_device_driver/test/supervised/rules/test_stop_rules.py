"""What ends every motion, named as in docs/safety.md."""

from __future__ import annotations

import pytest

from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import in_state
from ..ideal_axes import Bench


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
    assert bench.notices[-1].fault
    bench.cycle(1, holding=True)
    assert "still pressed" in bench.run(bench.supervisor.reset(bench.now)).message
    bench.supervisor.receive_estop(False)
    assert in_state(bench, State.ESTOPPED)
    assert not bench.supervisor.enable(True, bench.now).success
    assert "hold" in bench.run(bench.supervisor.reset(bench.now)).message
    bench.hold(False)
    assert bench.run(bench.supervisor.reset(bench.now)).success
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
    assert bench.run(bench.supervisor.reset(bench.now)).success
    wanted = State.UNCONFIGURED if state == "UNCONFIGURED" else State.DISABLED
    assert in_state(bench, wanted)


def test_one_device_stops_and_refuses_everything_until_it_is_alone_and_reset(
    bench: Bench,
) -> None:
    bench.ready()
    bench.command()
    bench.cycle(3, holding=True)
    at = bench.positions
    bench.supervisor.see_others("another device is there: /sim_rig")
    assert in_state(bench, State.FAULT)
    assert bench.last_rule is Rule.ONE_DEVICE
    assert bench.results[-1].outcome == "aborted: another device is there: /sim_rig"
    bench.cycle(20, holding=True)
    bench.command()
    bench.hold(False)
    supervisor = bench.supervisor
    for reply in (
        supervisor.enable(True, bench.now),
        bench.run(supervisor.home(bench.now)),
        supervisor.retract(bench.now),
        supervisor.confirm_needle_out(True),
        bench.run(supervisor.reset(bench.now)),
    ):
        assert not reply.success
    assert "/sim_rig" in bench.run(supervisor.reset(bench.now)).message
    supervisor.see_others("")
    assert in_state(bench, State.FAULT)
    assert bench.run(supervisor.reset(bench.now)).success
    assert bench.positions == at


def test_one_device_takes_back_the_word_that_the_needle_is_out(bench: Bench) -> None:
    bench.run(bench.supervisor.configure(bench.now))
    bench.supervisor.confirm_needle_out(True)
    bench.supervisor.see_others("another device is there: /sim_rig")
    bench.supervisor.see_others("")
    assert bench.run(bench.supervisor.reset(bench.now)).success
    assert "confirm first" in bench.run(bench.supervisor.home(bench.now)).message


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
    assert bench.status.insertion_m is None
    bench.hold(False)
    assert not bench.run(bench.supervisor.reset(bench.now)).success
    bench.rotation.silent_since = None
    assert bench.run(bench.supervisor.reset(bench.now)).success


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
    stops = bench.insertion.stops, bench.rotation.stops
    bench.run(bench.supervisor.deconfigure())
    assert bench.results[-1].outcome == "aborted: disabled on request"
    assert (bench.insertion.stops, bench.rotation.stops) == (stops[0] + 1, stops[1] + 1)


def test_configuration_that_fails_is_a_fault_with_the_reason(bench: Bench) -> None:
    bench.insertion.unplugged = True
    assert not bench.run(bench.supervisor.configure(bench.now)).success
    assert in_state(bench, State.FAULT)
    assert "no link" in bench.status.fault
    assert bench.run(bench.supervisor.reset(bench.now)).success
    assert in_state(bench, State.UNCONFIGURED)
