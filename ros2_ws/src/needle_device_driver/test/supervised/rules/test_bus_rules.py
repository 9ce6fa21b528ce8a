"""Rules for lost links and drives, named as in docs/safety.md."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.axes.link import LinkError
from needle_device_driver.cia402 import drive_setup
from needle_device_driver.link.object_access import ObjectAccess
from needle_device_driver.procedure import Procedure

from ..drive_bench import DriveBench

WATCHDOG = 127 << 16 | 100


def test_loop_heartbeat_is_sent_in_each_cycle_and_before_each_request() -> None:
    bench = DriveBench().configured()
    cobs = [cob for cob, _ in bench.bus.sent]
    requests = [number for number, cob in enumerate(cobs) if cob in (0x601, 0x602)]
    assert all(cobs[number - 1] == 0x77F for number in requests)
    bench.bus.sent.clear()
    bench.wait(5)
    assert [data for cob, data in bench.bus.sent if cob == 0x77F] == [b"\x05"] * 5
    assert bench.bus.sent[0][0] == 0x77F


def test_link_loss_is_reported_and_reset_reopens_the_link() -> None:
    bench = DriveBench().moving()
    bench.broken = "accepted no data for 0.05 s"
    bench.go()
    bench.failed("link_loss", "link virtual test is lost: accepted no data")
    # Without the computer the drives' watchdogs trip, and their state is unknown.
    bench.insertion.state = bench.rotation.state = "fault"
    bench.insertion.set_objects({(0x1016, 1): 0})
    bench.hold(False)
    bench.no_adapter = True
    assert "cannot open" in bench.reset().message
    assert bench.state == "FAULT"
    bench.no_adapter = False
    bench.stopped("link_loss", "accepted no data")
    assert bench.link.openings == 2
    assert bench.insertion.value(0x1016, 1) == WATCHDOG


def test_link_loss_while_idle_and_before_the_set_up() -> None:
    bench = DriveBench().configured()
    bench.link.set_port_error("gone")
    bench.supervisor.observe(bench.now)
    assert (bench.state, bench.rule) == ("FAULT", "link_loss")
    bench = DriveBench()
    bench.no_adapter = True
    assert "cannot open" in bench.configure().message
    assert bench.rule == "link_loss"
    with pytest.raises(LinkError, match="not open"):
        bench.link.send(0x80)


# ---- missing and late answers -------------------------------------------------------------------


def test_reply_age_heartbeats_renew_only_answered_positions() -> None:
    bench = DriveBench().configured()
    for _ in range(5):
        bench.now += 0.05
        bench.drives.beat()
        bench.supervisor.observe(bench.now)
    assert bench.state == "DISABLED"
    bench.insertion.syncs = False
    bench.wait(8)
    assert (bench.state, bench.rule) == ("FAULT", "reply_age")
    # Heartbeats in any state but operational do not count.
    bench = DriveBench().configured()
    bench.insertion.nmt = 0x7F
    bench.now += 0.2
    bench.drives.beat()
    bench.supervisor.observe(bench.now)
    assert bench.axes[1].poll(bench.now).time > bench.now - 0.1
    assert bench.supervisor.joints(bench.now) is None


@pytest.mark.parametrize(
    ("late", "cycles", "rule"),
    [
        (lambda _: 4, 80, ""),
        (lambda _: 5, 80, "reply_age"),
        (lambda cycle: cycle // 40, 400, "following_error"),
    ],
    ids=["80 ms", "100 ms", "growing"],
)
def test_reply_age_includes_late_answers(
    late: Callable[[int], int], cycles: int, rule: str
) -> None:
    bench = DriveBench().ready()
    drive, at, worst, most = bench.insertion, 0, 0.0, 0
    receive, sync = drive.receive, drive.sync

    def without_heartbeats(cob_id: int, data: bytes) -> None:
        # A heartbeat does not replace an answer.
        drive.emit(0x700, bytes([drive.nmt])) if cob_id == 0x77F else receive(cob_id, data)

    def noted() -> None:
        nonlocal at
        at = drive.position
        sync()

    drive.receive, drive.sync = without_heartbeats, noted  # type: ignore[method-assign]
    for number in range(cycles):
        drive.answers_late = late(number)
        most = max(most, drive.answers_late)
        if bench.state == "HOLDING":
            # At 5 mm/s.
            bench.submit((bench.joint(0) + 0.002, bench.joint(1), 0.4))
        bench.go()
        joints = bench.supervisor.joints(bench.now)
        if joints is not None:
            worst = max(worst, abs(joints.insertion.position - at / 20e6))
        drive.held_back = [(count - 1, frames) for count, frames in drive.held_back]
        drive.answer()
        bench.bus.flush()
        if bench.state == "FAULT":
            break
    assert worst <= min(most * 0.0001, 0.0006) + 1e-9
    assert (bench.rule if bench.state == "FAULT" else "") == rule
    assert rule or bench.drives.unanswered == cycles


def test_reply_age_lost_answers_are_discarded_after_a_pause() -> None:
    bench = DriveBench().moving()
    for _ in range(3):
        bench.insertion.loses = 1
        bench.go(30)
    assert bench.drives.unanswered == 3
    assert bench.outcomes == ["succeeded"]
    bench.step(0.002, 0.2, 1.0)
    bench.go(5)
    bench.insertion.loses = 2
    bench.go(3)
    # The third answer may belong to the first SYNC: no set-point for two cycles.
    waiting, syncs = bench.insertion.next_target, len(bench.bus.sent)
    bench.go(2)
    assert bench.insertion.next_target == waiting
    assert 0x80 not in [cob for cob, _ in bench.bus.sent[syncs:]]
    bench.go(2)
    assert bench.insertion.next_target > waiting
    bench.go(60)
    assert bench.outcomes == ["succeeded"] * 2
    syncs = [cob for cob, _ in bench.bus.sent].count(0x80)
    assert bench.axes[0].monitor.feedback.syncs == syncs
    count = bench.drives.unanswered
    health = bench.drives.health("")
    assert health.message == f"{count} cycles had no answer in time"
    assert health.values["unanswered_cycles"] == str(count)
    assert bench.drives.health("").message == "connected"


# ---- a drive that restarts ----------------------------------------------------------------------


def test_drive_reboot_of_a_self_starting_drive_needs_a_new_set_up() -> None:
    bench = DriveBench().homed()
    for drive in (bench.insertion, bench.rotation):
        drive.reboot()
        drive.nmt = 0x05
        drive.set_objects({(0x1016, 1): 0})
    bench.bus.flush()
    bench.wait(5)
    assert bench.state == "FAULT"
    assert bench.reset().success
    assert bench.insertion.value(0x1016, 1) == bench.rotation.value(0x1016, 1) == WATCHDOG
    assert not bench.is_homed()


def test_drive_reboot_is_detected_by_the_nmt_state() -> None:
    bench = DriveBench().moving()
    bench.rotation.nmt = 0x7F
    bench.drives.beat()
    bench.go()
    bench.failed("drive_reboot", "left the operational state")


def test_drive_reboot_voids_its_set_up(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = DriveBench().homed()
    reboots = [True]
    switch_off = drive_setup._switch_off_unused_pdos

    def reboots_once(access: ObjectAccess) -> Procedure[None]:
        if reboots:
            reboots.clear()
            bench.insertion.reboot()
            bench.bus.flush()
        yield from switch_off(access)

    monkeypatch.setattr(drive_setup, "_switch_off_unused_pdos", reboots_once)
    bench.after(bench.insertion.reboot)
    bench.hold(False)
    # The reboot undoes the first part of the set-up: only a complete one counts.
    assert "rebooted during set-up" in bench.reset().message
    assert bench.reset().success
    bench.wait(5)
    assert bench.state == "DISABLED"


@pytest.mark.parametrize(
    ("cob_id", "data", "what"),
    [
        (0x000, b"\x01\x00", "NMT"),
        (0x080, b"", "SYNC"),
        (0x77F, b"\x05", "the heartbeat of node 127"),
    ],
)
def test_one_master_second_master_stops_both(cob_id: int, data: bytes, what: str) -> None:
    bench = DriveBench().moving()
    bench.bus.put(cob_id, data)
    bench.go()
    bench.stopped("one_master", f"another master is on the bus: it sends {what}")
