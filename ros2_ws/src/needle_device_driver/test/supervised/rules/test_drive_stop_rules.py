"""How drives stop, and what stops both, named as in docs/safety.md."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.states import State

from ..checks import failed, in_state, recovers
from ..drive_bench import DriveBench

INSERTION, ROTATION = 1, 2


def test_quick_stop_goes_out_at_once_to_both(drive_bench: DriveBench) -> None:
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


def test_quick_stop_stays_and_forgets_the_set_point(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    for node in (INSERTION, ROTATION):
        assert bench.written(node, 0x605A) == b"\x06\x00"
    bench.hold(False)
    at = bench.positions
    bench.cycle(20, holding=True)
    assert bench.insertion.state == bench.rotation.state == "quick stop"
    assert bench.positions == at
    bench.step()
    bench.cycle(40, holding=True)
    assert bench.outcomes == ["aborted: hold released", "succeeded"]
    assert bench.positions[0] == at[0] + 20_000


def test_quick_stop_that_a_drive_only_says_switches_both_off(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    drive = bench.insertion
    follow = drive.follow

    def run_on() -> None:
        # A ramp that is none: 1 mm/s, as long as it has power.
        drive.demand += 400 * (drive.state == "quick stop")
        follow()

    drive.follow = run_on  # type: ignore[method-assign]
    bench.hold(False)
    at = drive.position
    bench.cycle(30)
    assert drive.state == bench.rotation.state == "disabled"
    assert drive.position - at <= 4_000, "0.2 mm: 0.2 s of them"
    failed(bench, Rule.ONE_FAULT_STOPS_BOTH, "runs on in its quick stop (2000 counts in 0.1 s)")
    drive.follow = follow  # type: ignore[method-assign]
    recovers(bench)


def test_quick_stop_option_that_a_drive_does_not_take_refuses_the_drive(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    sdo = bench.insertion.sdo

    def ignoring(data: bytes) -> None:
        sdo(data)
        bench.insertion.objects[0x605A, 0] = b"\x02\x00"

    bench.insertion.sdo = ignoring  # type: ignore[method-assign]
    reply = bench.run(bench.supervisor.configure(bench.clock()))
    assert not reply.success
    assert "took 6 for 0x605A:0 quick stop option and has 2" in reply.message


def test_drive_watchdog_is_armed_last_and_read_back(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.configured()
    for node in (INSERTION, ROTATION):
        assert bench.written(node, 0x1016, 1) == (127 << 16 | 100).to_bytes(4, "little")
        assert bench.written(node, 0x6007) == b"\x01\x00"
        assert bench.written(node, 0x605E) == b"\x02\x00"
        writes = [d for c, d in bench.bus.sent if c == 0x600 + node and d[0] & 0xE0 == 0x20]
        assert writes[-1] == bytes.fromhex("2316100164007f00")


def test_drive_watchdog_that_a_drive_does_not_keep_refuses_the_drive(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.insertion.stores = lambda index, value: bytes(4) if index == 0x1016 else value
    reply = bench.run(bench.supervisor.configure(bench.clock()))
    assert not reply.success
    assert "0x1016:1 consumer heartbeat time and has 0" in reply.message


def test_drive_watchdog_that_tripped_stops_both_and_has_its_name(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.fail(0x8130)
    bench.bus.flush()
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_WATCHDOG, "heartbeat was missed")
    assert bench.insertion.state == "disabled"
    recovers(bench)


def test_drive_watchdog_is_released_at_the_end(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.close()
    assert bench.insertion.state == bench.rotation.state == "disabled"
    for node in (INSERTION, ROTATION):
        assert bench.written(node, 0x1016, 1) == bytes(4)


def test_drive_watchdog_that_tripped_before_the_start_is_told_at_the_start(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.insertion.fail(0x8130)
    bench.insertion.out.clear()
    bench.run(bench.supervisor.configure(bench.clock()))
    assert in_state(bench, State.FAULT)
    assert bench.notices[-1].rule is Rule.DRIVE_WATCHDOG
    assert "insertion axis: the drive reports 0x8130" in bench.status.fault
    assert bench.insertion.state == "fault"
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    bench.cycle(3)
    assert in_state(bench, State.DISABLED)


@pytest.mark.parametrize(("code", "words"), [(0x2310, "over-current"), (0x7305, "encoder")])
def test_drive_emergency_stops_both_and_says_why(
    drive_bench: DriveBench, code: int, words: str
) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.fail(code)
    bench.bus.flush()
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_EMERGENCY, words)
    assert bench.rotation.state == "disabled"
    recovers(bench)


def test_drive_emergency_a_fault_without_message_counts_too(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.state = "fault"
    bench.cycle(1, holding=True)
    failed(bench, Rule.DRIVE_EMERGENCY, "rotation axis: the drive is in FAULT")
    recovers(bench)


def test_drive_emergency_no_reset_while_the_other_axis_is_still_stopping(
    drive_bench: DriveBench,
) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.fail(0x7305)
    bench.bus.flush()
    bench.cycle(1, holding=True)
    bench.hold(False)
    assert bench.rotation.state == "quick stop"
    reply = bench.run(bench.supervisor.reset(bench.clock()))
    assert reply.message == "rotation axis: is still stopping: reset again when it stands"
    assert in_state(bench, State.FAULT)
    bench.cycle(5)
    assert bench.rotation.state == "disabled"
    assert bench.run(bench.supervisor.reset(bench.clock())).success


def test_drive_emergency_that_stays_keeps_the_device_in_fault(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.insertion.fail(0x7121)
    bench.insertion.deaf_to_reset = True
    bench.bus.flush()
    bench.hold(False)
    bench.cycle(5)
    took = bench.insertion.sdo

    def late(data: bytes) -> None:
        bench.now += 0.05
        took(data)

    bench.insertion.sdo = late  # type: ignore[method-assign]
    reply = bench.run(bench.supervisor.reset(bench.clock()))
    assert not reply.success
    assert "0x7121 motor blocked" in reply.message
    assert in_state(bench, State.FAULT)
    # The edge counts: the order before was one to reset, too.
    bench.insertion.deaf_to_reset = False
    assert bench.run(bench.supervisor.reset(bench.clock())).success


def test_drive_emergency_a_drive_in_fault_takes_no_order_to_move(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    axis = bench.axes[0]
    bench.insertion.fail(0x2310)
    bench.bus.flush()
    orders: tuple[Callable[[], None], ...] = (
        lambda: axis.power(True),
        lambda: bench.run(axis.home(0.001)),
        lambda: axis.start_move(axis.poll(0.0).set_point, 0.001),
    )
    for order in orders:
        with pytest.raises(AxisError, match="over-current"):
            order()


def test_one_fault_stops_both_a_drive_that_switches_itself_off(drive_bench: DriveBench) -> None:
    bench = drive_bench
    bench.moving()
    bench.rotation.state = "disabled"
    bench.cycle(1, holding=True)
    failed(bench, Rule.ONE_FAULT_STOPS_BOTH, "by itself")
    assert bench.insertion.state == "disabled"


@pytest.mark.parametrize("reverse", [False, True])
def test_inner_limit_switch_stops_both_axes_at_once_and_leaves_the_way_out(
    make_drive_bench: Callable[..., DriveBench], reverse: bool
) -> None:
    bench = make_drive_bench(insertion_reverse=reverse)
    bench.ready()
    bench.cycle(1, holding=True)
    bench.step(0.002, 0.2, 1.0)
    bench.cycle(10, holding=True)
    # Its drive stops at the switch by itself, and says no more than that.
    bench.insertion.inputs = 1 if reverse else 2
    bench.insertion.blocked = True
    before = bench.rotation.position
    bench.cycle(2, holding=True)
    failed(bench, Rule.INNER_LIMIT_SWITCH, "inner limit switch")
    turned = (
        abs(bench.rotation.position - before) / bench.settings.drive("rotation").counts_per_unit
    )
    # Set-points of two cycles: 0.2 rad/s.
    assert turned <= 0.0081
    bench.insertion.blocked = False
    bench.hold(False)
    assert bench.run(bench.supervisor.reset(bench.clock())).success
    assert bench.supervisor.enable(True, bench.clock()).success
    bench.cycle(12)
    bench.hold(False)
    bench.cycle(1, holding=True)
    bench.step(0.001)
    assert bench.notices[-1].rule is Rule.INNER_LIMIT_SWITCH
    assert bench.supervisor.retract(bench.clock()).success
    at = abs(bench.insertion.position)
    bench.cycle(3, holding=True)
    assert abs(bench.insertion.position) < at
