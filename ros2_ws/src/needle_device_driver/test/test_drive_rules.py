"""The rules in the drives and on the bus, named as in docs/safety.md."""

from __future__ import annotations

from typing import Any, TypeAlias

import can
import pytest

from needle_device_driver.can_link import LinkError
from needle_device_driver.rules import Rule
from needle_device_driver.states import State

# conftest's; test modules cannot import it.
Bench: TypeAlias = Any

QUICK_STOP = 0x02
INSERTION, ROTATION = 1, 2


def in_state(bench: Bench, state: State) -> bool:
    """Return whether the device is in a state, in a way that no type checker remembers."""
    return bool(bench.state is state)


def written(bench: Bench, node: int, index: int, subindex: int = 0) -> bytes:
    """Return what a drive's object holds after set-up."""
    drive = bench.insertion if node == INSERTION else bench.rotation
    return bytes(drive.objects[index, subindex])


def failed(bench: Bench, rule: Rule, text: str) -> None:
    """Check that the device is in FAULT by a rule, and that nothing moves any more."""
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is rule
    assert text in bench.status.fault
    assert bench.outcomes[-1].startswith("aborted: ")
    at = bench.positions
    bench.cycle(10, holding=True)
    assert bench.positions == at
    assert in_state(bench, State.FAULT)


def recovers(bench: Bench) -> None:
    """Check that reset moves nothing and that a new command moves again, and only that."""
    at = bench.positions
    bench.hold(False)
    reply = bench.supervisor.reset(bench.clock())
    assert reply.success, reply.message
    bench.cycle(10)
    assert in_state(bench, State.DISABLED)
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(12)
    bench.hold(False)
    bench.cycle(3, holding=True)
    assert bench.positions == at
    bench.step()
    bench.cycle(30, holding=True)
    assert bench.outcomes[-1] == "succeeded"


def test_settling_time_names_an_axis_that_does_not_arrive(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.cycle(30, holding=True)
    # 0.1 mm before the target, within the following error.
    bench.insertion.blocked = True
    bench.cycle(12, holding=True)
    bench.insertion.position = 38_000
    bench.cycle(45, holding=True)
    assert in_state(bench, State.MOVING)
    bench.cycle(20, holding=True)
    failed(bench, Rule.SETTLING_TIME, "insertion 0.1000 mm")


def test_look_ahead_is_one_cycle_at_every_moment(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.002, 1.2, 0.4)
    bound = 0.005 * 0.02 * 20e6
    for _ in range(25):
        before = bench.insertion.position
        bench.cycle(1, holding=True)
        assert bench.insertion.next_target - before <= bound * 1.02
    assert bench.outcomes == ["succeeded"]


def test_look_ahead_refuses_a_set_point_that_is_further(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    at = bench.axes[0].poll(0.0).position
    with pytest.raises(Exception, match="ahead in a cycle") as caught:
        bench.axes[0].start_move(at + 0.0005, 0.025)
    assert getattr(caught.value, "rule", None) is Rule.LOOK_AHEAD


def test_look_ahead_without_further_set_points_the_drive_ends_its_motion(
    drive_bench: Bench,
) -> None:
    bench = drive_bench
    bench.moving()
    last = bench.insertion.next_target
    for _ in range(10):
        # The computer is dead; something else still sends SYNC.
        bench.insertion.sync()
    assert bench.insertion.position == last


def test_quick_stop_goes_out_at_once_to_both(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    sent = len(bench.bus.sent)
    bench.hold(False)
    frames = bench.bus.sent[sent:]
    assert [(cob, data) for cob, data in frames if cob in (0x201, 0x202)] == [
        (0x201, b"\x02\x00\x08"),
        (0x202, b"\x02\x00\x08"),
    ]
    assert not any(cob == 0x80 for cob, _ in frames)


def test_quick_stop_stays_and_forgets_the_set_point(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    for node in (INSERTION, ROTATION):
        assert written(bench, node, 0x605A) == b"\x06\x00"
    bench.hold(False)
    at = bench.positions
    bench.cycle(20, holding=True)
    assert bench.insertion.state == bench.rotation.state == "quick stop"
    assert bench.positions == at
    bench.step()
    bench.cycle(40, holding=True)
    assert bench.outcomes == ["aborted: hold released", "succeeded"]
    assert bench.positions[0] == at[0] + 20_000


def test_quick_stop_option_that_a_drive_does_not_take_refuses_the_drive(
    drive_bench: Bench,
) -> None:
    bench = drive_bench
    sdo = bench.insertion.sdo

    def ignoring(data: bytes) -> None:
        sdo(data)
        bench.insertion.objects[0x605A, 0] = b"\x02\x00"

    bench.insertion.sdo = ignoring
    reply = bench.supervisor.configure(bench.clock())
    assert not reply.success
    assert "took 6 for 0x605A:0 quick stop option and has 2" in reply.message


def test_drive_watchdog_is_armed_last_and_read_back(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.configured()
    for node in (INSERTION, ROTATION):
        assert written(bench, node, 0x1016, 1) == (127 << 16 | 100).to_bytes(4, "little")
        assert written(bench, node, 0x6007) == b"\x01\x00"
        assert written(bench, node, 0x605E) == b"\x02\x00"
        writes = [d for c, d in bench.bus.sent if c == 0x600 + node and d[0] & 0xE0 == 0x20]
        assert writes[-1] == bytes.fromhex("2316100164007f00")


def test_drive_watchdog_that_tripped_stops_both_and_has_its_name(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.fail(0x8130)
    bench.deliver(bench.rotation)
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_WATCHDOG, "heartbeat was missed")
    assert bench.insertion.state == "disabled"
    recovers(bench)


def test_drive_watchdog_is_released_at_the_end(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.close()
    assert bench.insertion.state == bench.rotation.state == "disabled"
    for node in (INSERTION, ROTATION):
        assert written(bench, node, 0x1016, 1) == bytes(4)


def test_loop_heartbeat_comes_with_each_cycle_and_never_without(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.configured()
    sent = len(bench.bus.sent)
    bench.cycle(5)
    frames = bench.bus.sent[sent:]
    assert [data for cob, data in frames if cob == 0x77F] == [b"\x05"] * 5
    assert [cob for cob, _ in frames[:1]] == [0x77F]
    sent = len(bench.bus.sent)
    # The loop hangs: as long as nobody calls, nothing goes out.
    with bench.link.arrival:
        bench.link.arrival.wait_for(lambda: False, 0.15)
    assert len(bench.bus.sent) == sent


def test_loop_heartbeat_goes_on_while_the_other_drive_is_set_up(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.configured()
    cobs = [cob for cob, _ in bench.bus.sent]
    requests = [i for i, cob in enumerate(cobs) if cob in (0x601, 0x602)]
    assert all(cobs[i - 1] == 0x77F for i in requests)


@pytest.mark.parametrize(
    "error", [can.CanOperationError("gone"), BrokenPipeError(32, "Broken pipe"), OSError(5, "I/O")]
)
def test_link_loss_is_named_and_reset_opens_the_link_anew(
    drive_bench: Bench, error: Exception
) -> None:
    bench = drive_bench
    bench.moving()
    bench.bus.error = error
    bench.cycle(1, holding=True)
    failed(bench, Rule.LINK_LOSS, "link virtual test is lost")
    # Without a computer the drives' watchdogs trip.
    bench.insertion.state = bench.rotation.state = "fault"
    bench.hold(False)
    bench.no_adapter = True
    reply = bench.supervisor.reset(bench.clock())
    assert not reply.success
    assert "cannot open" in reply.message
    assert in_state(bench, State.FAULT)
    bench.no_adapter = False
    recovers(bench)
    assert bench.link.openings == 2


def test_link_loss_while_nothing_is_sent_is_noticed_by_the_receiver(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.configured()
    bench.bus.error = can.CanOperationError("gone")
    with bench.link.arrival:
        assert bench.link.arrival.wait_for(lambda: bool(bench.link.lost), 5.0)
    bench.supervisor.observe(bench.clock())
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is Rule.LINK_LOSS


def test_link_loss_before_the_start_refuses_the_configuration(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.no_adapter = True
    assert "cannot open" in bench.supervisor.configure(bench.clock()).message
    with pytest.raises(LinkError, match="not open"):
        bench.link.send(0x80)


def test_reply_age_a_cut_bus_reports_nothing_and_is_found(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.bus.cut = True
    bench.wait = 0.001
    bench.cycle(1, holding=True)
    assert in_state(bench, State.MOVING)
    bench.skipped += 0.1
    bench.cycle(1, holding=True)
    failed(bench, Rule.REPLY_AGE, "no reply from an axis")
    assert bench.supervisor.joints(bench.clock()) is None
    assert not bench.supervisor.reset(bench.clock()).success
    bench.bus.cut = False
    bench.wait = 2.0
    bench.insertion.state = bench.rotation.state = "fault"
    recovers(bench)


def test_reply_age_a_heartbeat_keeps_positions_fresh_only_while_no_sync_is_unanswered(
    drive_bench: Bench,
) -> None:
    bench = drive_bench
    bench.configured()
    for _ in range(5):
        bench.skipped += 0.05
        bench.drives.beat()
        with bench.link.arrival:
            bench.link.arrival.wait_for(
                lambda: bench.axes[1].monitor._heartbeat_time > bench.clock() - 0.04, 5.0
            )
        bench.supervisor.observe(bench.clock())
    assert in_state(bench, State.DISABLED)
    # TPDOs end, heartbeats do not.
    bench.wait = 0.001
    bench.insertion.sync = lambda: None
    for _ in range(4):
        bench.skipped += 0.04
        bench.cycle()
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is Rule.REPLY_AGE


@pytest.mark.parametrize(("code", "words"), [(0x2310, "over-current"), (0x7305, "encoder")])
def test_drive_emergency_stops_both_and_says_why(drive_bench: Bench, code: int, words: str) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.fail(code)
    bench.deliver(bench.insertion)
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_EMERGENCY, words)
    assert bench.rotation.state == "disabled"
    recovers(bench)


def test_drive_emergency_a_fault_without_message_counts_too(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.state = "fault"
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_EMERGENCY, "rotation axis: the drive is in FAULT")
    recovers(bench)


def test_drive_emergency_that_stays_keeps_the_device_in_fault(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.fail(0x7121)
    bench.insertion.deaf_to_reset = True
    bench.deliver(bench.insertion)
    bench.cycle(1, holding=True)
    bench.hold(False)
    took = bench.insertion.sdo

    def late(data: bytes) -> None:
        bench.skipped += 0.05
        took(data)

    bench.insertion.sdo = late
    reply = bench.supervisor.reset(bench.clock())
    assert not reply.success
    assert "0x7121 motor blocked" in reply.message
    assert in_state(bench, State.FAULT)


def test_drive_reboot_is_a_fault_and_unhomes(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    deep = bench.insertion.position
    bench.insertion.reboot()
    bench.deliver(bench.insertion)
    bench.wait = 0.001
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_REBOOT, "home position is lost")
    assert not bench.status.homed
    bench.wait = 2.0
    bench.hold(False)
    assert bench.supervisor.reset(bench.clock()).success
    assert bench.insertion.nmt == 0x05
    assert written(bench, INSERTION, 0x1016, 1) == (127 << 16 | 100).to_bytes(4, "little")
    # No software limits before it is homed again.
    assert written(bench, INSERTION, 0x607D, 1) == bytes.fromhex("00000080")
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


def test_drive_reboot_a_node_that_left_operational_is_found_by_its_heartbeat(
    drive_bench: Bench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.nmt = 0x7F
    bench.wait = 0.001
    bench.drives.beat()
    with bench.link.arrival:
        bench.link.arrival.wait_for(lambda: bench.axes[1].monitor.left_operational, 5.0)
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_REBOOT, "left the operational state")


def test_drive_reboot_during_the_set_up_of_a_reset_is_not_forgotten(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.homed()
    bench.insertion.reboot()
    bench.rotation.reboot()
    bench.deliver(bench.insertion)
    bench.wait = 0.001
    bench.cycle(1)
    assert in_state(bench, State.FAULT)
    bench.wait = 2.0
    assert bench.supervisor.reset(bench.clock()).success
    assert not bench.status.homed


def test_software_limits_in_the_drives_come_with_homing(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.configured()
    for node in (INSERTION, ROTATION):
        assert written(bench, node, 0x607D, 1) == bytes.fromhex("00000080")
        assert written(bench, node, 0x607D, 2) == bytes.fromhex("ffffff7f")
    bench.supervisor.confirm_needle_out(True)
    bench.supervisor.home(bench.clock())
    bench.cycle(30)
    lower, upper = (
        int.from_bytes(written(bench, INSERTION, 0x607D, sub), "little", signed=True)
        for sub in (1, 2)
    )
    assert (lower, upper) == (-20_000, 4_020_000)


def test_software_limits_in_the_driver_refuse_a_set_point(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.ready()
    with pytest.raises(Exception, match="outside the drive's limits") as caught:
        bench.axes[0].start_move(0.3, 0.001)
    assert getattr(caught.value, "rule", None) is Rule.SOFTWARE_LIMITS


def test_one_fault_stops_both_a_drive_that_switches_itself_off(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.state = "disabled"
    bench.cycle(1, holding=True)
    failed(bench, Rule.ONE_FAULT_STOPS_BOTH, "by itself")
    assert bench.insertion.state == "disabled"


def test_no_motion_by_itself_set_up_enabling_and_reset_leave_a_drive_where_it_is(
    drive_bench: Bench,
) -> None:
    bench = drive_bench
    # Where the drive was left, with a set-point of someone else's.
    bench.insertion.position, bench.insertion.next_target = 12_345, 99_999
    bench.configured()
    bench.cycle(5)
    assert bench.insertion.position == 12_345
    # Someone turns the motor while it is off.
    bench.insertion.position = 55_555
    bench.cycle(1)
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(20)
    assert bench.insertion.state == "enabled"
    assert bench.insertion.position == 55_555


def test_following_error_of_a_blocked_motor(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.blocked = True
    for _ in range(20):
        bench.cycle(1, holding=True)
        if in_state(bench, State.FAULT):
            break
    failed(bench, Rule.FOLLOWING_ERROR, "mm off its set-point")
    assert bench.insertion.next_target - bench.insertion.position <= 0.7e-3 * 20e6
    at = bench.positions
    bench.insertion.blocked = False
    bench.cycle(10, holding=True)
    assert bench.positions == at, "a motor that comes free has no power to go on"
    recovers(bench)


def test_following_error_counts_from_the_set_point_that_was_due(make_drive_bench: Any) -> None:
    # A cycle's way at full speed is twice this bound.
    bench = make_drive_bench(insertion_following_error=5e-5)
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.002, 0.3, 0.4)
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]


def test_reply_age_heartbeats_of_a_drive_that_left_operational_keep_nothing_fresh(
    drive_bench: Bench,
) -> None:
    bench = drive_bench
    bench.configured()
    assert bench.supervisor.joints(bench.clock()) is not None
    bench.insertion.nmt = 0x7F
    bench.skipped += 0.2
    before = bench.link.frames_received
    bench.drives.beat()
    with bench.link.arrival:
        assert bench.link.arrival.wait_for(lambda: bench.link.frames_received >= before + 2, 5.0)
    bench.supervisor.observe(bench.clock())
    assert bench.axes[1].poll(bench.clock()).time > bench.clock() - 0.1
    assert bench.supervisor.joints(bench.clock()) is None


def test_drive_watchdog_that_tripped_before_the_start_is_told_at_the_start(
    drive_bench: Bench,
) -> None:
    bench = drive_bench
    bench.insertion.fail(0x8130)
    bench.insertion.out.clear()
    bench.supervisor.configure(bench.clock())
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is Rule.DRIVE_WATCHDOG
    assert "insertion axis: the drive reports 0x8130" in bench.status.fault
    assert bench.insertion.state == "fault"
    assert bench.supervisor.reset(bench.clock()).success
    bench.cycle(3)
    assert in_state(bench, State.DISABLED)


def test_look_ahead_an_axis_that_has_not_answered_is_not_sent_on(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.001, 1.0, 0.35)
    bench.cycle(3, holding=True)
    bench.wait = 0.001
    sync = bench.rotation.sync
    bench.rotation.sync = lambda: None
    bench.cycle(1, holding=True)
    waiting = bench.insertion.next_target, bench.rotation.next_target
    bench.cycle(5, holding=True)
    assert (bench.insertion.next_target, bench.rotation.next_target) == waiting
    assert in_state(bench, State.MOVING)
    # It was but a moment.
    bench.rotation.sync, bench.wait = sync, 2.0
    bench.cycle(30, holding=True)
    assert bench.outcomes == ["succeeded"]


def test_look_ahead_an_answer_that_comes_late_counts_in_the_next_cycle(
    make_drive_bench: Any,
) -> None:
    # Half a cycle's way: a position that is a cycle too old would break it.
    bench = make_drive_bench(insertion_following_error=5e-5)
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.001, 0.1, 0.2)
    bench.wait = 0.0
    for _ in range(20):
        bench.cycle(1, holding=True)
        with bench.link.arrival:
            assert bench.link.arrival.wait_for(
                lambda: all(axis.monitor.answered() for axis in bench.axes), 5.0
            )
    assert bench.outcomes == ["succeeded"]


def test_drive_reboot_on_the_way_out_leaves_what_is_left_of_the_way(drive_bench: Bench) -> None:
    bench = drive_bench
    bench.moving()
    bench.cycle(20, holding=True)
    depth, drawn_out = bench.insertion.position, 0
    for cycles in (10, 100):
        bench.insertion.reboot()
        bench.deliver(bench.insertion)
        bench.wait = 0.001
        bench.cycle(1)
        bench.wait = 2.0
        bench.hold(False)
        assert bench.supervisor.reset(bench.clock()).success
        bench.cycle(5)
        assert bench.supervisor.enable(True, bench.clock()).success
        bench.cycle(12)
        bench.hold(False)
        bench.cycle(1, holding=True)
        assert bench.supervisor.retract(bench.clock()).success
        bench.cycle(cycles, holding=True)
        drawn_out -= bench.insertion.position
    assert drawn_out == pytest.approx(depth, abs=4000)
