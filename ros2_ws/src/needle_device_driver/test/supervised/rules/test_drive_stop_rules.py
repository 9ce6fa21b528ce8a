"""Rules for stops, watchdogs and emergencies of drives, named as in docs/safety.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from needle_device_driver.axes.axis import AxisError

from ..drive_bench import DriveBench
from ..supervisor_bench import PERIOD

QUICK_STOP = b"\x02\x00\x08"


def test_quick_stop_is_sent_at_once_and_discards_the_set_point() -> None:
    bench = DriveBench().moving()
    bench.bus.sent.clear()
    bench.hold(False)
    assert bench.bus.sent == [(0x201, QUICK_STOP), (0x202, QUICK_STOP)]
    at = bench.positions
    bench.go(105)
    assert bench.insertion.state == bench.rotation.state == "quick stop"
    assert bench.positions == at
    bench.steps()
    assert bench.outcomes == ["aborted: hold released", "succeeded"]


def test_quick_stop_without_deceleration_switches_both_off() -> None:
    bench = DriveBench().moving()
    # The drive does not decelerate: 1 mm/s as long as it has power.
    bench.insertion.drift = {"quick stop": 400}
    at = bench.insertion.position
    bench.hold(False)
    bench.wait(30)
    assert bench.insertion.state == bench.rotation.state == "disabled"
    assert bench.insertion.position - at <= 4_400, "0.2 mm: 0.2 s of them"
    bench.insertion.drift = {}
    bench.stopped("one_fault_stops_both", "keeps moving in its quick stop (2000 counts in 0.1 s)")


# Behaviour of the drive after an emergency stop; report after a number of cycles; final state.
Row = tuple[str, dict[str, Any], list[tuple[int, str]], str]
UNSTOPPED: dict[str, Row] = {
    "stops": ("insertion", {}, [(cycle, "") for cycle in (1, 8, 9, 45, 52)], "disabled"),
    "only says": ("insertion", {"drift": {"quick stop": 400}}, [(20, ""), (10, "")], "disabled"),
    "ignores the stop": (
        "insertion",
        {"drift": {"enabled": 400}, "ignored_orders": {"quick stop"}},
        [(12, "still moving"), (30, ""), (10, "")],
        "disabled",
    ),
    "keeps its power": (
        "rotation",
        {"ignored_orders": {"off"}},
        [(49, ""), (5, "still powered"), (0, "still powered")],
        "quick stop",
    ),
    "stands and takes no stop": (
        "insertion",
        {"ignored_orders": {"quick stop"}},
        [(50, ""), (2, "still powered"), (53, "")],
        "disabled",
    ),
    "runs on powered": (
        "insertion",
        {"drift": {"enabled": 400}, "ignored_orders": {"quick stop", "off"}},
        [(60, "still powered and moving")],
        "enabled",
    ),
    "runs on without power": (
        "insertion",
        {"drift": {"quick stop": 400, "disabled": 400}},
        [(60, "still moving")],
        "disabled",
    ),
    "is moved by hand": ("insertion", {"drift": {"disabled": 800}}, [(32, "")], "disabled"),
    "is silent": ("rotation", {"silent": True}, [(3, ""), (5, "silent")], "quick stop"),
}


@pytest.mark.parametrize("name", UNSTOPPED)
def test_quick_stop_ignored_after_estop_is_reported_while_it_lasts(
    name: str,
) -> None:
    which, changes, cycles, end = UNSTOPPED[name]
    bench = DriveBench().moving()
    drive = getattr(bench, which)
    for attribute, value in changes.items():
        setattr(drive, attribute, value)
    bench.supervisor.receive_estop(True)
    assert bench.status.fault == "emergency stop"
    faults = []
    for number, what in cycles:
        for _ in range(number):
            bench.wait()
            faults += [bench.status.fault] * (bench.status.fault not in faults)
        suffix = f"; {which} axis {what}" if what else ""
        assert bench.status.fault == f"emergency stop{suffix}"
    assert drive.state == end
    reported = [str(notice) for notice in bench.notices if notice.fault][1:]
    assert reported == [f"{fault[16:]} [quick_stop]" for fault in faults[1:]]
    # The report ends with the cause, and with a reset.
    bench.supervisor.receive_estop(False)
    bench.hold(False)
    drive.drift, drive.silent, drive.state = {}, False, "disabled"
    bench.wait(12)
    assert bench.status.fault == "emergency stop"
    assert bench.reset().success
    bench.wait(2)
    assert bench.status.fault == ""


def test_quick_stop_ignored_after_a_fault_is_reported() -> None:
    bench = DriveBench().moving()
    bench.insertion.drift = {"quick stop": 400, "disabled": 400}
    bench.after(lambda: bench.rotation.fail(0x2310))
    bench.wait(60)
    reports = "rotation axis: the drive reports 0x2310 continuous over-current"
    assert bench.status.fault == f"{reports}; insertion axis still moving"


def test_quick_stop_at_exit_leaves_time_for_answers() -> None:
    bench = DriveBench().moving()
    sync, times = bench.insertion.sync, []

    def noted() -> None:
        times.append(bench.now)
        sync()

    bench.insertion.sync = noted  # type: ignore[method-assign]
    bench.run(bench.axes[0].close())
    assert bench.insertion.state == "disabled"
    assert len(times) > 3
    # Half a cycle, as each SYNC is answered at once.
    assert np.diff(times) == pytest.approx([PERIOD / 2] * (len(times) - 1))


# ---- watchdog and emergencies -------------------------------------------------------------------


def test_drive_watchdog_is_armed_last_and_disarmed_at_exit() -> None:
    bench = DriveBench().configured()
    for drive in (bench.insertion, bench.rotation):
        assert (drive.value(0x6007), drive.value(0x605E)) == (1, 2)
        sent = [d for c, d in bench.bus.sent if c == 0x600 + drive.node and d[0] & 0xE0 == 0x20]
        assert sent[-1] == bytes.fromhex("2316100164007f00")
    bench = DriveBench().moving()
    # A drive that does not report off keeps its watchdog.
    bench.insertion.syncs = False
    bench.run(bench.supervisor.deconfigure())
    assert bench.state == "FAULT"
    assert "insertion axis: does not confirm power-off" in bench.notices[-1].text
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
    assert bench.insertion.state == "fault"
    assert bench.reset().success
    bench.wait(3)
    assert bench.state == "DISABLED"
    # A cleared error from before the set-up does not count.
    bench = DriveBench()
    bench.insertion.emit(0x80, bytes.fromhex("0573000000000000"))
    bench.configured()
    assert bench.state == "DISABLED"


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
    with pytest.raises(AxisError, match="encoder error"):
        bench.run(bench.axes[0].home(0.001))
    bench.hold(False)
    stopping = "rotation axis: is still stopping: reset again after it stops"
    reset = bench.reset()
    assert (reset.success, reset.message) == (False, stopping)
    assert bench.state == "FAULT"
    bench.stopped("drive_emergency", "the drive reports 0x7305 encoder error")
    # A fault without an emergency message counts, too.
    bench.rotation.state = "fault"
    bench.go(2)
    bench.failed("drive_emergency", "rotation axis: the drive is in FAULT")


@pytest.mark.parametrize(
    ("lacking", "why"), [(set(), ": 0x7121 motor blocked"), ({0x603F}, "")], ids=["code", "none"]
)
def test_drive_emergency_that_persists_keeps_the_fault(lacking: set[int], why: str) -> None:
    bench = DriveBench().homed()
    drive = bench.insertion
    drive.ignores_reset, drive.missing_objects = True, lacking
    bench.after(lambda: drive.fail(0x7121))
    bench.hold(False)
    bench.wait(5)
    bench.sdo_time = 0.05
    reset = bench.reset()
    wanted = f"insertion axis: the drive does not leave its fault{why}"
    assert (reset.success, reset.message) == (False, wanted)
    assert bench.state == "FAULT"
    # Only the edge counts: the last command was a reset already.
    drive.ignores_reset, drive.missing_objects = False, set()
    assert bench.reset().success


@pytest.mark.parametrize(("seconds", "leaves"), [(0.9, True), (1.1, False)])
def test_drive_emergency_reset_may_take_a_second(seconds: float, leaves: bool) -> None:
    bench = DriveBench().homed()
    bench.after(lambda: bench.insertion.fail(0x7121))
    bench.hold(False)
    bench.wait(5)
    bench.sdo_time = 0.02
    bench.delay_reaction(bench.insertion, seconds)
    assert bench.reset().success is leaves


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
