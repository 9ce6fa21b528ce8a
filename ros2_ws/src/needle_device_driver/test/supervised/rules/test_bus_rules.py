"""Links, cables and drives that are lost, named as in docs/safety.md."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.cia402 import drive_setup
from needle_device_driver.cia402.pdo_setup import silence_unused
from needle_device_driver.link.frame_link import LinkError
from needle_device_driver.link.object_access import ObjectAccess
from needle_device_driver.procedure import Procedure
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import failed, in_state, recovers
from ..drive_bench import DriveBench

INSERTION = 1


def test_loop_heartbeat_comes_with_each_cycle_and_never_without(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    sent = len(bench.bus.sent)
    bench.cycle(5)
    frames = bench.bus.sent[sent:]
    assert [data for cob, data in frames if cob == 0x77F] == [b"\x05"] * 5
    assert [cob for cob, _ in frames[:1]] == [0x77F]


def test_loop_heartbeat_goes_on_while_the_other_drive_is_set_up(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    cobs = [cob for cob, _ in bench.bus.sent]
    requests = [i for i, cob in enumerate(cobs) if cob in (0x601, 0x602)]
    assert all(cobs[i - 1] == 0x77F for i in requests)


def test_link_loss_is_named_and_reset_opens_the_link_anew(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.broken = "takes nothing for 0.05 s"
    bench.cycle(1, holding=True)
    failed(bench, Rule.LINK_LOSS, "link virtual test is lost: takes nothing")
    # Without a computer the drives' watchdogs trip.
    bench.insertion.state = bench.rotation.state = "fault"
    bench.hold(False)
    bench.no_adapter = True
    reply = bench.run(bench.supervisor.reset(bench.clock()))
    assert not reply.success
    assert "cannot open" in reply.message
    assert in_state(bench, State.FAULT)
    bench.no_adapter = False
    # Nobody knows what happened to the drives meanwhile.
    bench.insertion.objects[0x1016, 1] = bytes(4)
    recovers(bench)
    assert bench.link.openings == 2
    assert bench.written(INSERTION, 0x1016, 1) != bytes(4)


def test_link_loss_while_nothing_is_sent_is_noticed_too(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    bench.link.change("gone")
    bench.supervisor.observe(bench.clock())
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is Rule.LINK_LOSS


def test_link_loss_before_the_start_refuses_the_configuration(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.no_adapter = True
    assert "cannot open" in bench.run(bench.supervisor.configure(bench.clock())).message
    with pytest.raises(LinkError, match="not open"):
        bench.link.send(0x80)


def test_reply_age_a_cut_bus_reports_nothing_and_is_found(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.bus.cut = True
    bench.cycle(1, holding=True)
    assert in_state(bench, State.MOVING)
    bench.now += 0.1
    bench.cycle(1, holding=True)
    failed(bench, Rule.REPLY_AGE, "no reply from an axis")
    assert bench.supervisor.joints(bench.clock()) is None
    assert not bench.run(bench.supervisor.reset(bench.clock())).success
    bench.bus.cut = False
    bench.insertion.state = bench.rotation.state = "fault"
    recovers(bench)


def test_reply_age_a_heartbeat_keeps_positions_fresh_only_while_no_sync_is_unanswered(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    for _ in range(5):
        bench.now += 0.05
        bench.drives.beat()
        bench.supervisor.observe(bench.clock())
    assert in_state(bench, State.DISABLED)
    # TPDOs end, heartbeats do not.
    bench.insertion.sync = lambda: None  # type: ignore[method-assign]
    bench.cycle(8)
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is Rule.REPLY_AGE


@pytest.mark.parametrize("which", ["insertion", "rotation"])
@pytest.mark.parametrize("late", [2, 3, 4])
def test_reply_age_an_axis_that_answers_late_is_not_sent_on_meanwhile(
    drive_bench: DriveBench, which: str, late: int
) -> None:
    bench = drive_bench
    bench.moving()
    getattr(bench, which).answers_late = late
    for _ in range(40):
        bench.cycle(1, holding=True)
        joints = bench.supervisor.joints(bench.clock())
        if joints is not None:
            # Three cycles' way at 2 mm/s; answers to SYNCs of long ago would be off by more.
            assert abs(joints.insertion.position - bench.insertion.position / 20e6) <= 0.0001201
    assert bench.drives.unanswered > 10


def staleness(bench: DriveBench, late: Callable[[int], int], cycles: int) -> float:
    """Insert at 5 mm/s while answers come so many cycles late, between two SYNCs.

    Returns
    -------
    float
        How far the joints were off from where the drive was at the last SYNC at most [m].
    """
    bench.ready()
    bench.cycle(1, holding=True)
    drive, took, sync = bench.insertion, bench.insertion.take, bench.insertion.sync
    at, worst = 0, 0.0

    def take(cob_id: int, data: bytes) -> None:
        # No heartbeat brings an answer.
        drive.say(0x700, bytes([drive.nmt])) if cob_id == 0x77F else took(cob_id, data)

    def note_sync() -> None:
        nonlocal at
        at = drive.position
        sync()

    drive.take, drive.sync = take, note_sync  # type: ignore[method-assign]
    for number in range(cycles):
        drive.answers_late = late(number)
        if in_state(bench, State.HOLDING):
            told = [axis.poll(bench.clock()).set_point for axis in bench.axes]
            step = bench.command(told[0] + 0.002, told[1], bench.ros_ns, 0.4)
            bench.supervisor.submit(step, bench.clock())
        bench.cycle(1, holding=True)
        joints = bench.supervisor.joints(bench.clock())
        if joints is not None:
            worst = max(worst, abs(joints.insertion.position - at / 20e6))
        drive.held_back = [(count - 1, frames) for count, frames in drive.held_back]
        drive.answer()
        bench.bus.flush()
        if in_state(bench, State.FAULT):
            break
    return worst


@pytest.mark.parametrize("late", [1, 2, 3, 4])
def test_reply_age_joints_are_no_older_than_answers_are_late(
    drive_bench: DriveBench, late: int
) -> None:
    assert staleness(drive_bench, lambda _: late, 150) <= late * 0.0001 + 1e-9
    assert not in_state(drive_bench, State.FAULT)
    assert drive_bench.drives.unanswered == 150


@pytest.mark.parametrize(
    ("late", "rule"),
    [(lambda _: 5, Rule.REPLY_AGE), (lambda cycle: cycle // 40, Rule.FOLLOWING_ERROR)],
    ids=["100 ms", "growing"],
)
def test_reply_age_answers_that_are_too_late_end_the_motion(
    drive_bench: DriveBench, late: Callable[[int], int], rule: Rule
) -> None:
    assert staleness(drive_bench, late, 400) <= 0.0006 + 1e-9
    assert in_state(drive_bench, State.FAULT)
    assert drive_bench.notices[-1].rule is rule


def test_reply_age_one_lost_answer_is_counted_and_holds_nothing_up(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    for _ in range(3):
        bench.insertion.loses = 1
        bench.cycle(30, holding=True)
    assert bench.drives.unanswered == 3
    bench.cycle(30, holding=True)
    assert bench.outcomes[-1] == "succeeded"


def test_reply_age_two_lost_answers_are_given_up_after_two_cycles_without_sync(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.loses = 2
    bench.cycle(3, holding=True)
    # The third answer may be to the first SYNC: nothing is sent on.
    waiting = bench.insertion.next_target
    bench.cycle(2, holding=True)
    assert bench.insertion.next_target == waiting
    bench.cycle(60, holding=True)
    assert bench.outcomes == ["succeeded"]


def test_reply_age_heartbeats_of_a_drive_that_left_operational_keep_nothing_fresh(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.configured()
    assert bench.supervisor.joints(bench.clock()) is not None
    bench.insertion.nmt = 0x7F
    bench.now += 0.2
    bench.drives.beat()
    bench.supervisor.observe(bench.clock())
    assert bench.axes[1].poll(bench.clock()).time > bench.clock() - 0.1
    assert bench.supervisor.joints(bench.clock()) is None


def test_drive_reboot_is_a_fault_and_unhomes(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.cycle(20, holding=True)
    # Deeper than the software limits reach outward: un-homed, they do not count.
    deep = bench.insertion.position
    assert deep > 20_000
    bench.insertion.reboot()
    bench.bus.flush()
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_REBOOT, "home position is lost")
    assert not bench.status.homed
    bench.hold(False)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    assert bench.insertion.nmt == 0x05
    assert bench.written(INSERTION, 0x1016, 1) == (127 << 16 | 100).to_bytes(4, "little")
    # No software limits before it is homed again.
    assert bench.written(INSERTION, 0x607D, 1) == bytes.fromhex("00000080")
    bench.cycle(5)
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(12)
    bench.hold(False)
    bench.cycle(1, holding=True)
    bench.step()
    assert bench.notices[-1].rule is Rule.HOMED_FIRST
    # Outward by the depth that was known, in the new count.
    assert bench.supervisor.retract(bench.clock()).success
    bench.cycle(100, holding=True)
    # The last that was heard is a cycle old.
    assert bench.insertion.position == pytest.approx(-deep, abs=2000)
    assert "out" in bench.supervisor.retract(bench.clock()).message


def test_drive_reboot_one_that_starts_by_itself_is_set_up_anew_all_the_same(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.reboot()
    bench.insertion.nmt = 0x05
    bench.insertion.objects[0x1016, 1] = bytes(4)
    bench.bus.flush()
    bench.cycle(1, holding=True)
    bench.hold(False)
    bench.cycle(5)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    assert bench.written(INSERTION, 0x1016, 1) != bytes(4)
    assert not bench.status.homed


def test_drive_reboot_a_node_that_left_operational_is_found_by_its_heartbeat(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.nmt = 0x7F
    bench.drives.beat()
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_REBOOT, "left the operational state")


def test_drive_reboot_during_the_set_up_of_a_reset_is_not_forgotten(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.homed()
    bench.insertion.reboot()
    bench.rotation.reboot()
    bench.bus.flush()
    bench.cycle(1)
    assert in_state(bench, State.FAULT)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    assert not bench.status.homed


def test_drive_reboot_within_its_set_up_voids_it(
    drive_bench: DriveBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = drive_bench
    bench.homed()
    reboots = [True]

    def reboots_once(access: ObjectAccess) -> Procedure[None]:
        if reboots:
            reboots.clear()
            bench.insertion.reboot()
            bench.bus.flush()
        yield from silence_unused(access)

    monkeypatch.setattr(drive_setup, "silence_unused", reboots_once)
    bench.insertion.reboot()
    bench.bus.flush()
    bench.cycle(1)
    assert in_state(bench, State.FAULT)
    # What it was told before it started anew is gone: only a whole set-up counts.
    refused = bench.run(bench.supervisor.reset(bench.clock()))
    assert not refused.success
    assert "started anew while it was set up" in refused.message
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    bench.cycle(5)
    assert in_state(bench, State.DISABLED)


def test_drive_reboot_on_the_way_out_leaves_what_is_left_of_the_way(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.cycle(20, holding=True)
    depth, drawn_out = bench.insertion.position, 0
    for cycles in (10, 100):
        bench.insertion.reboot()
        bench.bus.flush()
        bench.hold(False)
        bench.cycle(8)
        assert bench.run(bench.supervisor.reset(bench.clock())).success
        bench.cycle(5)
        assert bench.supervisor.enable(True, bench.clock()).success
        bench.cycle(12)
        bench.hold(False)
        bench.cycle(1, holding=True)
        assert bench.supervisor.retract(bench.clock()).success
        bench.cycle(cycles, holding=True)
        drawn_out -= bench.insertion.position
    assert drawn_out == pytest.approx(depth, abs=4000)


@pytest.mark.parametrize(
    ("cob_id", "data", "what"),
    [
        (0x000, b"\x01\x00", "NMT"),
        (0x080, b"", "SYNC"),
        (0x77F, b"\x05", "the heartbeat of node 127"),
    ],
)
def test_one_master_another_on_the_bus_is_named_and_stops_both(
    drive_bench: DriveBench, cob_id: int, data: bytes, what: str
) -> None:
    bench = drive_bench
    bench.moving()
    bench.bus.put(cob_id, data)
    bench.cycle(1, holding=True)
    failed(bench, Rule.ONE_MASTER, f"another master is on the bus: it sends {what}")
    recovers(bench)
