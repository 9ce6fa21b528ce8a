"""Rules for lost links and drives, named as in docs/safety.md."""

from __future__ import annotations

import pytest

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
    bench.bus.fault = "accepted no data for 0.05 s"
    bench.go()
    bench.failed("link_loss", "link virtual test is lost: accepted no data")
    assert bench.drives.health("").message.startswith("link virtual test is lost")
    # Without the computer the drives' watchdogs trip, and their state is unknown.
    bench.insertion.state = bench.rotation.state = "fault"
    bench.insertion.set_objects({(0x1016, 1): 0})
    bench.hold(False)
    bench.bus.absent = True
    assert "cannot open" in bench.reset().message
    assert bench.state == "FAULT"
    bench.bus.absent = False
    bench.stopped("link_loss", "accepted no data")
    assert bench.bus.openings == 2
    assert bench.insertion.value(0x1016, 1) == WATCHDOG


def test_link_loss_before_the_set_up() -> None:
    bench = DriveBench()
    bench.bus.absent = True
    assert "cannot open" in bench.configure().message
    assert bench.rule == "link_loss"


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


@pytest.mark.parametrize(
    ("cycles_late", "state", "rule"), [(4, "MOVING", ""), (5, "FAULT", "reply_age")]
)
def test_reply_age_includes_late_answers(cycles_late: int, state: str, rule: str) -> None:
    bench = DriveBench().ready()
    bench.insertion.answers_late = cycles_late
    bench.step(0.002, 0.1, 0.4)
    bench.go(80)
    assert (bench.state, bench.rule) == (state, rule)


def test_reply_age_lost_answers_are_discarded_after_a_pause() -> None:
    bench = DriveBench().moving()
    bench.insertion.loses = 2
    bench.go(3)
    # The third answer may belong to the first SYNC: no set-point and no SYNC for two cycles.
    waiting, sent = bench.insertion.next_target, len(bench.bus.sent)
    bench.go(2)
    assert bench.insertion.next_target == waiting
    assert 0x80 not in [cob for cob, _ in bench.bus.sent[sent:]]
    bench.go(2)
    assert bench.insertion.next_target > waiting
    bench.go(60)
    assert bench.outcomes == ["succeeded"]
    count = bench.drives.unanswered
    assert bench.drives.health("").message == f"{count} cycles had no answer in time"
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


def test_drive_reboot_voids_its_set_up() -> None:
    bench = DriveBench().homed()
    drive, reboots = bench.insertion, [True]

    def reboot_once(index: int, *_: object) -> int:
        if index == 0x1017 and reboots:
            reboots.clear()
            drive.reboot()
        return 0

    bench.after(drive.reboot)
    bench.hold(False)
    drive.refuses = reboot_once
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
