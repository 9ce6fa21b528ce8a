"""Orders that take several frames: side by side, replied to in time, called off at once."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from needle_core.component import Answer, Peers
from needle_core.runners.faults import silence

from .component_bench import DRIVER, DRIVES, ComponentBench, losing

SDO = (0x601, 0x602)
LIMITS, HOMING_SPEEDS, WATCHDOG, DEVICE_TYPE = 0x607D, 0x6099, 0x1016, 0x1000


def set_up(bench: ComponentBench) -> None:
    bench.set_up()


def homing(bench: ComponentBench) -> None:
    bench.set_up()
    bench.mark()
    assert bench.call("home").success


def reset(bench: ComponentBench) -> None:
    bench.moving()
    bench.drives.bus.emergency("insertion", 0x2310)
    bench.until(lambda: bench.state == "FAULT")
    bench.person.pressed = False
    bench.run(0.5)
    bench.mark()
    assert bench.call("reset").success


@pytest.mark.parametrize("order", [set_up, homing, reset], ids=lambda order: order.__name__)
def test_both_drives_are_asked_side_by_side(order: Callable[[ComponentBench], None]) -> None:
    bench = ComponentBench()
    order(bench)
    times = {
        cob_id: [
            t
            for t, _, f in bench.frames
            if t >= bench.marked and f.identifier == cob_id and bench.entry(f)[0] != DEVICE_TYPE
        ]
        for cob_id in SDO
    }
    assert len(times[0x601]) > 2
    assert times[0x601][0] < times[0x602][-1]
    assert times[0x602][0] < times[0x601][-1]


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
    bench.until(lambda: bench.person.status["homed"] == "true")
    first = min(t for t, f in bench.driver_frames(0x201, 0x202) if f.data[0] & 0x10)
    taken = {
        (f.identifier, *bench.entry(f)): t
        for t, _, f in bench.frames
        if t >= bench.marked and f.identifier in (0x581, 0x582) and f.data[0] == 0x60
    }
    wanted = [
        (0x581 + node, index, subindex)
        for node in (0, 1)
        for index in (LIMITS, HOMING_SPEEDS)
        for subindex in (1, 2)
    ]
    assert all(taken[key] < min(first, replied) for key in wanted)


@pytest.mark.parametrize("cob_id", SDO)
def test_arming_the_watchdog_is_the_last_setting_of_a_set_up(cob_id: int) -> None:
    bench = ComponentBench()
    bench.set_up()
    settings = [f for f in bench.sent(0.0, cob_id) if f.data[0] & 0xE0 == 0x20]
    assert len(settings) > 20
    assert bench.entry(settings[-1])[0] == WATCHDOG
    assert settings[-1].data[4:8] == (127 << 16 | 100).to_bytes(4, "little")


# ---- replies -----------------------------------------------------------------------------------


def test_home_is_answered_when_it_has_begun() -> None:
    bench = ComponentBench(drives={"insertion_start": 0.01})
    bench.set_up()
    assert bench.call("home").success
    bench.run(0.002)
    assert bench.person.status["activity"] == "homing"
    assert bench.person.status["homed"] == "false"
    assert bench.places[0] > 0.009


def test_reset_is_answered_when_it_has_ended() -> None:
    bench = ComponentBench()
    reset(bench)
    bench.mark()
    assert bench.state == "DISABLED"
    bench.run(1.0)
    assert bench.sent(bench.marked, *SDO) == []


def test_retract_is_answered_at_once() -> None:
    bench = ComponentBench()
    bench.ready()
    bench.step()
    bench.until(lambda: bool(bench.person.outcomes))
    bench.ask("retract")
    # The person acts every 0.01 s; on the way there and back a message takes 1.5 ms at most.
    assert bench.until(lambda: bench.person.answers[-1].service == "device/retract") < 0.02
    assert bench.person.answers[-1].success


# ---- called off --------------------------------------------------------------------------------


def another_device(bench: ComponentBench) -> None:
    bench.inject(Peers(publishers={"device/status": (DRIVER, "sim_rig")}))


RESET_CALLED_OFF: dict[str, Callable[[ComponentBench], None]] = {
    "emergency stop": lambda b: b.press_stop(),
    "stop": lambda b: b.ask("stop"),
    "disable": lambda b: b.ask("enable", False),
    "fault": another_device,
}


@pytest.mark.parametrize("name", RESET_CALLED_OFF)
def test_a_reset_that_is_called_off_sends_nothing_more_and_fails(name: str) -> None:
    lost = [math.inf]
    bench = ComponentBench(fault=losing([0x582], lambda: lost[0]))
    bench.moving()
    bench.drives.bus.emergency("insertion", 0x2310)
    bench.until(lambda: bench.state == "FAULT")
    bench.person.pressed = False
    bench.run(0.5)
    lost[0] = bench.runner.now
    bench.ask("reset")
    bench.until(lambda: bool(bench.sent(lost[0], 0x602)))
    answers = len(bench.person.answers)
    RESET_CALLED_OFF[name](bench)

    def replies() -> dict[str, Answer]:
        return {a.service: a for a in bench.person.answers[answers:]}

    bench.until(lambda: "device/reset" in replies())
    assert not replies()["device/reset"].success
    assert "called off" in replies()["device/reset"].text
    bench.mark()
    bench.run(1.5)
    assert bench.sent(bench.marked, *SDO) == []
    assert bench.state in ("FAULT", "ESTOPPED")


def test_an_emergency_stop_calls_a_set_up_off_until_it_is_released() -> None:
    bench = ComponentBench()
    bench.until(lambda: len(bench.sent(0.0, 0x601)) > 10)
    bench.press_stop()
    bench.until(lambda: bench.state == "ESTOPPED")
    bench.mark()
    bench.run(1.5)
    # It looks whether they are still there, and no more.
    assert {bench.entry(f)[0] for f in bench.sent(bench.marked, *SDO)} == {DEVICE_TYPE}
    bench.press_stop(False)
    bench.until(lambda: bench.state == "DISABLED")


# ---- begin -------------------------------------------------------------------------------------


def test_drives_that_come_late_are_set_up() -> None:
    bench = ComponentBench(fault=silence(DRIVES, 0.0, 3.0), connect_timeout=5.0)
    bench.until(lambda: bench.state == "DISABLED", 8.0)


@pytest.mark.parametrize("axis", ["insertion", "rotation"])
def test_a_drive_that_refuses_its_set_up_ends_the_driver_at_once(axis: str) -> None:
    bench = ComponentBench()
    del bench.drives.bus.drives[axis]._objects._entries[0x605A, 0]
    assert bench.until(lambda: DRIVER in bench.runner.exits) < 3.0
    ended = bench.runner.exits[DRIVER]
    assert ended.code == 2
    assert f"{axis} axis: node" in ended.text
    assert "refuses to write 6 to 0x605A" in ended.text
    # The other one does not wait for a computer that is gone.
    bench.run(1.0)
    assert all(drive.error_code == 0 for drive in bench.drives.bus.drives.values())


def test_with_another_device_nothing_begins() -> None:
    bench = ComponentBench()
    # Not before they know each other.
    bench.run(0.25)
    assert bench.state == "UNCONFIGURED"
    another_device(bench)
    bench.until(lambda: DRIVER in bench.runner.exits)
    assert bench.runner.exits[DRIVER].code == 2
    assert "another device is there: sim_rig" in bench.runner.exits[DRIVER].text
