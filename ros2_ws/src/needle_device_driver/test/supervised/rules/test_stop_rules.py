"""Rules that end every motion, named as in docs/safety.md."""

from __future__ import annotations

import math
from typing import Any

import pytest

from needle_core.diagnostics import Level
from needle_core.status_messages import DeviceStatus

from ..ideal_axes import Bench
from ..supervisor_bench import accepted, rejected


def test_nothing_is_reported_before_the_set_up() -> None:
    at_start = DeviceStatus(level=Level.WARN, text="UNCONFIGURED", state="UNCONFIGURED")
    bench = Bench()
    assert (bench.status, bench.supervisor.stops) == (at_start, 0)


def test_estop_latches_until_hold_release_and_reset() -> None:
    bench = Bench().moving()
    at = bench.positions
    bench.supervisor.receive_estop(True)
    assert (bench.state, bench.rule) == ("ESTOPPED", "estop_latches")
    assert bench.insertion.orders[-2:] == bench.rotation.orders[-2:] == ["stop", "off"]
    assert bench.outcomes == ["aborted: emergency stop"]
    assert (bench.status.fault, bench.status.level) == ("emergency stop", 2)
    bench.go()
    assert bench.reset() == rejected("the emergency stop is still pressed")
    bench.supervisor.receive_estop(False)
    assert bench.state == "ESTOPPED"
    assert not bench.enable().success
    assert bench.reset() == rejected("release the hold first")
    bench.hold(False)
    assert bench.reset() == accepted("reset; enable to continue")
    assert (bench.state, bench.status.fault) == ("DISABLED", "")
    bench.go(20)
    assert bench.positions == at


@pytest.mark.parametrize("state", ["UNCONFIGURED", "DISABLED", "HOLDING", "FAULT"])
def test_estop_latches_from_every_state(state: str) -> None:
    bench = Bench()
    if state != "UNCONFIGURED":
        bench.homed()
    if state == "HOLDING":
        bench.enable()
    if state == "FAULT":
        bench.supervisor.fail("test")
    assert bench.state == state
    bench.supervisor.receive_estop(True)
    bench.supervisor.fail("later")
    assert (bench.state, bench.status.fault) == ("ESTOPPED", "emergency stop")
    bench.supervisor.receive_estop(False)
    reset = "enable to continue" if state != "UNCONFIGURED" else "the device is not configured"
    assert bench.reset() == accepted(f"reset; {reset}")
    assert bench.state == ("UNCONFIGURED" if state == "UNCONFIGURED" else "DISABLED")


def test_one_device_refuses_everything_until_the_conflict_ends() -> None:
    bench = Bench().moving()
    supervisor, other = bench.supervisor, "another device is running: /sim_rig"
    supervisor.report_conflicting_device(other)
    supervisor.report_conflicting_device(other)
    assert (bench.state, bench.rule, supervisor.stops) == ("FAULT", "one_device", 1)
    assert bench.outcomes == [f"aborted: {other}"]
    bench.hold(False)
    for reply in (bench.enable(), supervisor.confirm_needle_out(True), bench.reset()):
        assert not reply.success
    assert bench.reset() == rejected(other)
    supervisor.report_conflicting_device("")
    assert bench.state == "FAULT"
    assert bench.reset().success
    # The confirmation may have been meant for the other device.
    supervisor.confirm_needle_out(True)
    supervisor.report_conflicting_device(other)
    supervisor.report_conflicting_device("")
    assert bench.reset().success
    assert "confirm first" in bench.run(supervisor.home(bench.now)).message


@pytest.mark.parametrize("which", ["insertion", "rotation"])
@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"fault": "overcurrent"}, "{} axis: overcurrent"),
        ({"powered": False}, "an axis lost its power"),
        ({"homed": False}, "an axis lost its home position"),
        ({"unplugged": True}, "{}: no link"),
    ],
    ids=["fault", "power", "home", "link"],
)
def test_one_fault_stops_both(which: str, change: dict[str, Any], text: str) -> None:
    bench = Bench().moving()
    axis = bench.axis(which)
    (other,) = {bench.insertion, bench.rotation} - {axis}
    axis.__dict__.update(change)
    bench.go()
    fault = text.format(which)
    assert (bench.state, bench.status.fault) == ("FAULT", fault)
    assert [str(n) for n in bench.notices if n.fault] == [f"{fault} [one_fault_stops_both]"]
    assert bench.outcomes == [f"aborted: {fault}"]
    assert other.orders[-2:] == ["stop", "off"]
    at = other.position
    bench.go(10)
    assert other.position == at


def test_one_fault_stops_both_without_motion() -> None:
    bench = Bench().ready()
    bench.insertion.homed = False
    bench.go()
    assert bench.state == "HOLDING"
    bench.rotation.powered = False
    bench.go()
    assert bench.state == "FAULT"
    bench.hold(False)
    bench.rotation.unplugged = True
    assert bench.reset() == rejected("rotation: no link")
    bench.rotation.unplugged = False
    assert bench.reset().success


@pytest.mark.parametrize("which", ["insertion", "rotation"])
def test_reply_age_silent_axis_is_a_fault_without_joints(which: str) -> None:
    bench = Bench().moving()
    axis = bench.axis(which)
    silent_since = axis.silent_since = bench.now
    bench.supervisor.observe(silent_since + 0.0999)
    assert bench.state == "MOVING"
    assert bench.supervisor.joints(silent_since + 0.0999) is not None
    assert bench.supervisor.joints(silent_since + 0.1001) is None
    bench.now = silent_since + 0.1001
    bench.supervisor.observe(bench.now)
    assert (bench.state, bench.rule) == ("FAULT", "reply_age")
    assert bench.status.watchdog_trips == 1
    assert bench.status.insertion_m is bench.status.rotation_rad is None
    bench.hold(False)
    assert "no reply from an axis for 0.100 s, limit 0.1 s" in bench.reset().message
    axis.silent_since = math.inf
    assert bench.reset().success


def test_disable_and_close_end_a_motion() -> None:
    bench = Bench().moving()
    bench.insertion.unplugged = True
    assert bench.enable(False) == rejected("insertion: no link")
    bench = Bench().moving()
    assert bench.enable(False) == accepted("disabled")
    assert bench.state == "DISABLED"
    assert bench.insertion.orders[-2:] == bench.rotation.orders[-2:] == ["stop", "off"]
    assert bench.outcomes == ["aborted: disabled on request"]
    assert bench.enable().success
    assert bench.enable() == accepted("already enabled")
    bench.press()
    bench.step()
    bench.run(bench.supervisor.deconfigure())
    assert bench.outcomes == ["aborted: disabled on request"] * 2
    assert bench.insertion.orders[-3:] == bench.rotation.orders[-3:] == ["stop", "off", "close"]
    assert (bench.state, bench.status.insertion_m) == ("UNCONFIGURED", None)
    assert bench.enable() == rejected("the device is UNCONFIGURED, not DISABLED")
    bench.supervisor.fail("test")
    bench.run(bench.supervisor.deconfigure())
    assert bench.state == "FAULT"
