"""Rules for stops, watchdogs and emergencies of drives, named as in docs/safety.md."""

from __future__ import annotations

from typing import Any

import pytest

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.rules import Rule

from ..drive_bench import DriveBench

QUICK_STOP = b"\x02\x00\x08"


def test_quick_stop_is_sent_at_once_and_discards_the_set_point() -> None:
    bench = DriveBench().moving()
    bench.bus.sent.clear()
    bench.hold(False)
    assert bench.bus.sent == [(0x201, QUICK_STOP), (0x202, QUICK_STOP)]
    at = bench.positions
    bench.go(105)
    assert bench.positions == at
    bench.steps()
    assert bench.outcomes == ["aborted: hold released", "succeeded"]


# Axis, behaviour of its drive after an emergency stop, reports after numbers of cycles, end.
Row = tuple[str, dict[str, Any], list[tuple[int, str]], str]
UNSTOPPED: dict[str, Row] = {
    "stops": ("insertion", {}, [(9, ""), (100, "")], "disabled"),
    "ignores the stop": (
        "insertion",
        {"drift": {"enabled": 400}, "ignored_orders": {"quick stop"}},
        [(12, "still moving"), (30, ""), (10, "")],
        "disabled",
    ),
    "keeps its power": (
        "rotation",
        {"ignored_orders": {"off"}},
        [(49, ""), (5, "still powered")],
        "quick stop",
    ),
    "runs on powered": (
        "insertion",
        {"drift": {"enabled": 400}, "ignored_orders": {"quick stop", "off"}},
        [(60, "still powered and moving")],
        "enabled",
    ),
    "is moved by hand": ("insertion", {"drift": {"disabled": 800}}, [(32, "")], "disabled"),
    "is silent": ("rotation", {"silent": True}, [(3, ""), (5, "silent")], "quick stop"),
}


@pytest.mark.parametrize("name", UNSTOPPED)
def test_quick_stop_ignored_after_estop_is_reported_while_it_lasts(name: str) -> None:
    which, changes, cycles, end = UNSTOPPED[name]
    bench = DriveBench().moving()
    drive = getattr(bench, which)
    drive.__dict__.update(changes)
    bench.supervisor.receive_estop(True)
    for number, what in cycles:
        bench.wait(number)
        suffix = f"; {which} axis {what}" if what else ""
        assert bench.status.fault == f"emergency stop{suffix}"
    assert drive.state == end
    reported = [notice.text for notice in bench.notices if notice.rule is Rule.QUICK_STOP]
    assert reported[-1:] == [f"{which} axis {what}" for _, what in cycles if what][-1:]
    # The report ends with the cause.
    drive.drift, drive.silent, drive.state = {}, False, "disabled"
    bench.wait(12)
    assert bench.status.fault == "emergency stop"


def test_quick_stop_ignored_after_a_fault_is_reported() -> None:
    bench = DriveBench().moving()
    bench.insertion.drift = {"quick stop": 400, "disabled": 400}
    bench.after(lambda: bench.rotation.fail(0x2310))
    bench.wait(60)
    reports = "rotation axis: the drive reports 0x2310 continuous over-current"
    assert bench.status.fault == f"{reports}; insertion axis still moving"


# ---- watchdog and emergencies -------------------------------------------------------------------


def test_drive_watchdog_is_disarmed_at_exit_by_a_drive_that_is_off() -> None:
    bench = DriveBench().moving()
    # A drive that does not report off keeps its watchdog.
    bench.insertion.syncs = False
    before = len(bench.bus.sent)
    bench.run(bench.supervisor.deconfigure())
    assert bench.state == "FAULT"
    assert "insertion axis: does not confirm power-off" in bench.notices[-1].text
    # The silent drive is given up after 16 cycles; the other one is at rest and off after five.
    assert [cob for cob, _ in bench.bus.sent[before:]].count(0x80) == 16 + 5
    assert bench.insertion.value(0x1016, 1) == 127 << 16 | 100
    assert (bench.rotation.value(0x1016, 1), bench.rotation.state) == (0, "disabled")
    with pytest.raises(AxisError, match="insertion axis is not configured"):
        bench.axes[0].start_move(0.0, 0.001)


def test_drive_watchdog_trip_is_named_also_before_the_set_up() -> None:
    bench = DriveBench().moving()
    bench.after(lambda: bench.rotation.fail(0x8130))
    bench.stopped("drive_watchdog", "heartbeat was missed")
    bench = DriveBench()
    bench.insertion.fail(0x8130)
    bench.insertion.out.clear()
    bench.configure()
    assert (bench.state, bench.rule) == ("FAULT", "drive_watchdog")
    assert "insertion axis: the drive reports 0x8130" in bench.status.fault
    assert bench.reset().success
    # A cleared error from before the set-up does not count.
    bench = DriveBench()
    bench.insertion.emit(0x80, bytes.fromhex("0573000000000000"))
    assert bench.configured().state == "DISABLED"


def test_drive_emergency_stops_both_and_is_acknowledged_by_pdo() -> None:
    bench = DriveBench().moving()
    for drive in (bench.insertion, bench.rotation):
        drive.ignores_sdo_orders = True
        # The drives answer with samples of the previous SYNC.
        drive.answers_previous_sample = True
    bench.after(lambda: bench.insertion.fail(0x7305))
    assert bench.rotation.state == "quick stop"
    with pytest.raises(AxisError, match="encoder error"):
        bench.axes[0].power(True)
    bench.hold(False)
    assert "rotation axis: is still stopping: reset again" in bench.reset().message
    assert bench.state == "FAULT"
    bench.stopped("drive_emergency", "the drive reports 0x7305 encoder error")
    # A fault without an emergency message counts, too.
    bench.rotation.state = "fault"
    bench.go(2)
    bench.failed("drive_emergency", "rotation axis: the drive is in FAULT")


def test_drive_emergency_that_persists_keeps_the_fault() -> None:
    bench = DriveBench().homed()
    bench.insertion.ignored_orders = {"reset"}
    bench.after(lambda: bench.insertion.fail(0x7121))
    bench.hold(False)
    bench.wait(5)
    bench.sdo_time, before = 0.05, bench.now
    assert "the drive does not leave its fault: 0x7121 motor blocked" in bench.reset().message
    assert 1.0 < bench.now - before < 1.5
    assert bench.state == "FAULT"
    # Only the edge counts: the last command was a reset already.
    bench.insertion.ignored_orders = set()
    assert bench.reset().success


def test_drive_emergency_between_cycles_refuses_a_retraction() -> None:
    bench = DriveBench().moving()
    bench.press()
    bench.insertion.fail(0x7305)
    bench.bus.flush()
    reply = bench.retract()
    assert (reply.success, "encoder error" in reply.message) == (False, True)
    assert (bench.state, bench.rule) == ("FAULT", "drive_emergency")


def test_one_fault_stops_both_if_a_drive_switches_itself_off() -> None:
    bench = DriveBench().moving()
    bench.after(lambda: setattr(bench.rotation, "state", "disabled"))
    bench.failed("one_fault_stops_both", "changed from OPERATION_ENABLED to SWITCH_ON_DISABLED")
    assert bench.insertion.state == "disabled"
