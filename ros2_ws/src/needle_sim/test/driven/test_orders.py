"""Orders that take several frames: side by side, replied to in time, called off at once."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest

from .component_bench import DRIVES, AnotherDevice, ComponentBench, losing

SDO = (0x601, 0x602)
LIMITS, HOMING_SPEEDS, DEVICE_TYPE = 0x607D, 0x6099, 0x1000


def fault(bench: ComponentBench) -> None:
    """Have a fault in the middle of a step, and be where a reset may be ordered."""
    bench.moving()
    bench.drives.bus.emergency("insertion", 0x2310)
    bench.release()


def test_both_drives_are_asked_side_by_side_and_a_reset_is_answered_when_it_has_ended() -> None:
    bench = ComponentBench()

    def check() -> None:
        first, second = (
            [time for time, frame in bench.sent(cob_id) if bench.entry(frame)[0] != DEVICE_TYPE]
            for cob_id in SDO
        )
        assert len(first) > 2
        assert first[0] < second[-1]
        assert second[0] < first[-1]
        bench.mark()

    bench.set_up()
    check()
    bench.home()
    check()
    bench.arm()
    fault(bench)
    bench.mark()
    assert bench.call("reset").success
    check()
    assert bench.status.state == "DISABLED"
    bench.run(0.5)
    assert bench.sent(*SDO) == []


@pytest.mark.parametrize("slow", SDO)
def test_homing_begins_when_both_drives_have_taken_limits_and_speeds(slow: int) -> None:
    begin = [math.inf]
    lost = losing([slow - 0x80], lambda: begin[0], lambda: begin[0] + 0.3)
    bench = ComponentBench(drives={"insertion_start": 0.002}, fault=lost)
    bench.set_up()
    # One drive's answers are lost for a while: it is asked again.
    begin[0] = bench.runner.now
    bench.mark()
    assert bench.call("home").success
    replied = bench.runner.now
    bench.until(lambda: bench.status.homed)
    first = min(t for t, f in bench.sent(0x201, 0x202) if f.data[0] & 0x10)
    taken = {
        (f.identifier, *bench.entry(f)): t
        for t, f in bench.sent(0x581, 0x582, by=DRIVES)
        if f.data[0] == 0x60
    }
    wanted = itertools.product((0x581, 0x582), (LIMITS, HOMING_SPEEDS), (1, 2))
    assert all(taken[key] < min(first, replied) for key in wanted)


def test_home_is_answered_when_it_has_begun_and_retract_at_once() -> None:
    bench = ComponentBench(drives={"insertion_start": 0.002})
    bench.home()
    bench.run(0.002)
    assert (bench.status.activity, bench.status.homed) == ("homing", False)
    assert bench.places[0] > 0.001
    bench.arm()
    bench.step()
    bench.until(lambda: bench.outcomes)
    bench.ask("retract")
    # The person acts every 0.01 s; on the way there and back a message takes 1.5 ms at most.
    assert bench.until(lambda: "retract" in bench.answers) < 0.02
    assert bench.answers["retract"].success


# ---- called off --------------------------------------------------------------------------------

CALLS_OFF: dict[str, Callable[[ComponentBench], None]] = {
    "emergency stop": lambda b: b.press_stop(),
    "stop": lambda b: b.ask("stop"),
    "disable": lambda b: b.ask("enable", False),
    "fault": lambda b: b.drives.bus.reboot("insertion", b.runner.now),
    "another device": lambda b: b.runner.start(AnotherDevice()),
}


@pytest.mark.parametrize(
    ("order", "why"),
    [
        *itertools.product(("home",), ("emergency stop", "stop", "disable", "fault")),
        *itertools.product(("reset",), ("emergency stop", "stop", "disable", "another device")),
    ],
)
def test_an_order_that_is_called_off_sends_nothing_more_and_moves_nothing(
    order: str, why: str
) -> None:
    lost = [math.inf]
    drives = {} if order == "reset" else {"insertion_start": 0.01, "boot_time": 0.0}
    bench = ComponentBench(fault=losing([0x582], lambda: lost[0]), drives=drives)
    if order == "reset":
        fault(bench)
    else:
        bench.set_up()
    bench.mark()
    lost[0] = bench.runner.now
    bench.ask(order)
    # The insertion drive has acknowledged all of its own; the rotation drive is silent.
    bench.until(lambda: bool(bench.sent(0x602)))
    bench.person.answers.clear()
    CALLS_OFF[why](bench)
    bench.until(lambda: order in bench.answers)
    assert not bench.answers[order].success
    assert "called off" in bench.answers[order].text
    starts = [frame for _, frame in bench.sent(0x201, 0x202) if frame.data[0] & 0x10]
    assert starts == []
    bench.mark()
    assert bench.rests(1.5)
    assert bench.sent(*SDO) == []
    states = {drive.state.name for drive in bench.drives.bus.drives.values()}
    assert "OPERATION_ENABLED" not in states


def test_heartbeat_goes_on_while_a_drive_is_silent_and_no_second_order_is_taken() -> None:
    lost = [math.inf]
    bench = ComponentBench(fault=losing([0x582], lambda: lost[0]))
    bench.set_up()
    lost[0] = bench.runner.now
    bench.mark()
    bench.ask("home")
    bench.run(0.45)
    beats = [time for time, _ in bench.sent(0x77F)]
    assert max(later - before for before, later in itertools.pairwise(beats)) < 0.04
    assert "another order is under way" in bench.call("reset").text
    bench.until(lambda: bench.status.state == "FAULT", 2.0)
    assert "node 2 does not answer" in bench.status.fault
    assert not bench.answers["home"].success


def test_an_emergency_stop_calls_a_set_up_off_until_it_is_released() -> None:
    bench = ComponentBench()
    bench.until(lambda: len(bench.sent(0x601)) > 10)
    bench.press_stop()
    bench.until(lambda: bench.status.state == "ESTOPPED")
    bench.mark()
    bench.run(1.5)
    # It looks whether they are still there, and no more.
    assert {bench.entry(frame)[0] for _, frame in bench.sent(*SDO)} == {DEVICE_TYPE}
    bench.press_stop(False)
    bench.until(lambda: bench.status.state == "DISABLED")


# ---- begin -------------------------------------------------------------------------------------


def test_a_drive_that_refuses_its_set_up_ends_the_driver_at_once() -> None:
    bench = ComponentBench()
    del bench.drives.bus.drives["rotation"]._objects._entries[0x605A, 0]
    assert bench.until(lambda: bench.ended) < 3.0
    code, text = bench.ended or (0, "")
    assert code == 2
    assert "rotation axis: node" in text
    assert "refuses to write 6 to 0x605A" in text
    # The other one does not wait for a computer that is gone.
    bench.run(0.5)
    assert bench.error_codes == {0}


def test_with_another_device_nothing_begins() -> None:
    bench = ComponentBench()
    bench.runner.start(AnotherDevice())
    bench.until(lambda: bench.ended)
    code, text = bench.ended or (0, "")
    assert code == 2
    assert "another device is there: sim_rig" in text
    assert {bench.entry(frame)[0] for _, frame in bench.sent(*SDO)} <= {DEVICE_TYPE}
