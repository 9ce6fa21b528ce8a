"""The driver's component on the emulated drives: orders, faults, and who stops what."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest

from needle_core.component import PortChange
from needle_core.runners.faults import delay, silence
from needle_device_driver.cia402 import cia402_axis
from needle_device_driver.device_driver import EXIT_BROKEN

from .component_bench import DRIVER, DRIVES, ComponentBench, losing

SDO = (0x601, 0x602)
STEP = 0.002


def test_it_sets_the_drives_up_homes_and_moves_them() -> None:
    bench = ComponentBench(drives={"insertion_start": 0.001})
    bench.ready()
    bench.step(STEP, 0.5, 1.0)
    bench.until(lambda: bool(bench.person.outcomes))
    assert bench.person.outcomes == ["succeeded"]
    assert bench.places[0] == pytest.approx(STEP, abs=1e-5)
    assert bench.places[1] == pytest.approx(0.5, abs=2e-3)
    assert bench.person.status["simulated"] == "true"
    assert bench.person.status["watchdog_trips"] == "0"


def test_a_frame_takes_its_time_and_cycles_stay_a_period_apart() -> None:
    bench = ComponentBench()
    bench.ready()
    since = bench.runner.now
    bench.step()
    bench.run(1.0)
    times = [t for t, _, f in bench.frames if t > since and f.identifier == 0x80]
    gaps = [later - before for before, later in itertools.pairwise(times)]
    assert len(times) == pytest.approx(50, abs=1)
    assert 0.0195 < min(gaps) <= max(gaps) < 0.0205


PLANTED: dict[str, tuple[Callable[[ComponentBench], None], str, float]] = {
    "stall": (lambda b: b.drives.bus.stall("insertion"), "following error", 0.4),
    "power loss": (lambda b: b.drives.bus.reboot("rotation", b.runner.now), "no reply", 0.15),
    "emergency": (lambda b: b.drives.bus.emergency("insertion", 0x2310), "over-current", 0.05),
    "hang": (lambda b: b.drives.bus.hang("insertion"), "no reply", 0.15),
    "cut": (lambda b: setattr(b.drives.bus, "is_cut", True), "no reply", 0.15),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_fault_of_one_drive_stops_both(name: str) -> None:
    plant, fault, within = PLANTED[name]
    bench = ComponentBench()
    bench.moving()
    at = bench.places
    plant(bench)
    assert bench.until(lambda: bench.state == "FAULT", 1.0) < within
    assert fault in bench.fault
    bench.run(0.2)
    # 2 mm/s and 0.5 rad/s until the fault is known, and the ramps.
    assert bench.places[0] - at[0] < 0.002 * (within + 0.05)
    assert bench.places[1] - at[1] < 0.5 * (within + 0.05)
    assert bench.rests()
    assert bench.person.outcomes[-1].startswith("aborted: ")


def test_after_a_fault_a_reset_lets_it_go_on() -> None:
    bench = ComponentBench()
    bench.moving()
    bench.drives.bus.reboot("rotation", bench.runner.now)
    bench.until(lambda: bench.state == "FAULT")
    bench.person.pressed = False
    bench.run(1.0)
    assert bench.call("reset").success
    assert bench.person.status["homed"] == "false"
    assert bench.rests()
    bench.ready()
    bench.step()
    bench.until(lambda: bench.person.outcomes[-1] == "succeeded")


def test_drives_stop_by_themselves_when_the_driver_stands_still() -> None:
    bench = ComponentBench()
    bench.moving()
    bench.runner.freeze(DRIVER, 1.0)
    at = bench.places
    bench.run(0.05)
    stopped = bench.places
    # A set-point that was sent is still gone to, and no further.
    assert stopped[0] - at[0] < 0.002 * 0.05
    assert bench.rests(0.3)
    for drive in bench.drives.bus.drives.values():
        assert drive.error_code == 0x8130
    bench.until(lambda: bench.state == "FAULT", 2.0)
    assert "heartbeat was missed" in bench.fault
    assert bench.places == stopped


def test_frames_that_are_late_are_no_fault() -> None:
    bench = ComponentBench(fault=delay("can", 0.004))
    bench.moving()
    bench.until(lambda: bool(bench.person.outcomes))
    assert bench.person.outcomes == ["succeeded"]


# ---- orders that are called off ----------------------------------------------------------------

CALLED_OFF: dict[str, Callable[[ComponentBench], None]] = {
    "emergency stop": lambda b: b.press_stop(),
    "stop": lambda b: b.ask("stop"),
    "disable": lambda b: b.ask("enable", False),
    "fault": lambda b: b.drives.bus.reboot("insertion", b.runner.now),
}


@pytest.mark.parametrize("name", CALLED_OFF)
def test_a_homing_that_is_called_off_sends_nothing_more_and_moves_nothing(name: str) -> None:
    lost = [math.inf]
    bench = ComponentBench(
        fault=losing([0x582], lambda: lost[0]), drives={"insertion_start": 0.01, "boot_time": 0.0}
    )
    bench.set_up()
    lost[0] = bench.runner.now
    bench.ask("home")
    # The insertion drive has acknowledged all of its own; the rotation drive is silent.
    bench.until(lambda: bool(bench.sent(lost[0], 0x602)))
    answers = len(bench.person.answers)
    CALLED_OFF[name](bench)
    bench.until(lambda: len(bench.person.answers) > answers)
    replies = {a.service: a for a in bench.person.answers[answers:]}
    assert not replies["device/home"].success
    assert "called off" in replies["device/home"].text
    since = bench.runner.now
    at = bench.places
    bench.run(1.5)
    assert bench.sent(since, *SDO) == []
    assert bench.places == at
    starts = [f for f in bench.sent(lost[0], 0x201, 0x202) if f.data[0] & 0x10]
    assert starts == []
    assert all(
        drive.state.name != "OPERATION_ENABLED" for drive in bench.drives.bus.drives.values()
    )


def test_heartbeat_and_status_go_on_while_a_drive_is_silent() -> None:
    lost = [math.inf]
    bench = ComponentBench(fault=losing([0x582], lambda: lost[0]))
    bench.set_up()
    lost[0] = bench.runner.now
    bench.ask("home")
    bench.run(0.45)
    beats = [t for t, sender, f in bench.frames if sender == DRIVER and f.identifier == 0x77F]
    gaps = [later - before for before, later in itertools.pairwise(beats[5:])]
    assert max(gaps) < 0.04
    assert "another order is under way" in bench.call("reset").text
    bench.until(lambda: bench.state == "FAULT", 2.0)
    assert "node 2 does not answer" in bench.fault
    assert not bench.person.answers[-1].success


# ---- the end, and what is broken ---------------------------------------------------------------


def test_the_watchdog_is_released_at_the_end() -> None:
    bench = ComponentBench()
    bench.ready()
    bench.runner.stop(DRIVER)
    bench.until(lambda: DRIVER in bench.runner.exits)
    assert bench.runner.exits[DRIVER].code == 0
    bench.run(0.5)
    for drive in bench.drives.bus.drives.values():
        assert drive.state.name == "SWITCH_ON_DISABLED"
        assert drive.error_code == 0


def test_a_stop_while_it_moves_brings_the_axes_to_rest_first() -> None:
    bench = ComponentBench()
    bench.moving()
    bench.runner.stop(DRIVER)
    bench.until(lambda: DRIVER in bench.runner.exits, 2.0)
    assert bench.rests()
    assert all(drive.error_code == 0 for drive in bench.drives.bus.drives.values())


def test_drives_that_are_not_there_end_it() -> None:
    bench = ComponentBench(fault=silence(DRIVES, 0.0, math.inf), connect_timeout=3.0)
    bench.until(lambda: DRIVER in bench.runner.exits, 8.0)
    assert bench.runner.exits[DRIVER].code == 2
    assert "node 1 does not answer" in bench.runner.exits[DRIVER].text


def _breaks(*_: Any) -> Any:
    raise ZeroDivisionError("planted")


def test_a_handler_that_raises_stops_both_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = ComponentBench()
    bench.moving()
    monkeypatch.setattr(bench.driver.supervisor, "submit", _breaks)
    bench.step()
    bench.until(lambda: bench.state == "FAULT", 0.2)
    assert "internal error: ZeroDivisionError: planted" in bench.fault
    assert DRIVER not in bench.runner.exits
    bench.run(0.1)
    assert bench.person.health["handlers"]["failures"] == "1"
    assert bench.rests()


def test_an_order_that_raises_ends_and_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = ComponentBench()
    bench.set_up()
    monkeypatch.setattr(cia402_axis, "write_homing", _breaks)
    assert bench.call("home").text == "called off: internal error"
    assert "internal error: ZeroDivisionError: planted" in bench.fault
    assert DRIVER not in bench.runner.exits
    assert bench.call("reset").success


# ---- the port ----------------------------------------------------------------------------------


@pytest.mark.parametrize("why", ["unplugged", "its send buffer is full"])
def test_a_lost_port_stops_both_and_a_reset_opens_it_anew(why: str) -> None:
    bench = ComponentBench()
    bench.moving()
    at = bench.places
    bench.inject(PortChange(why))
    # The person acts every 0.01 s; the driver then needs no cycle of its own.
    assert bench.until(lambda: bench.state == "FAULT") < 0.015
    assert f"link virtual can is lost: {why}" in bench.fault
    bench.mark()
    bench.person.pressed = False
    bench.run(0.2)
    assert bench.driver_frames() == []
    assert bench.places[0] - at[0] < 0.002 * 0.05
    for drive in bench.drives.bus.drives.values():
        assert drive.error_code == 0x8130
    assert f"cannot open virtual can: {why}" in bench.call("reset").text
    bench.inject(PortChange())
    bench.run(0.02)
    assert bench.call("reset").success
    bench.ready()
    bench.step()
    bench.until(lambda: bench.person.outcomes[-1] == "succeeded")


def test_a_port_that_opens_in_time_is_waited_for() -> None:
    bench = ComponentBench(fault=silence(DRIVES, 0.0, 0.3))
    bench.run(0.25)
    bench.inject(PortChange("no such file"))
    bench.until(lambda: "no such file" in bench.person.health.get("can", {}).get("text", ""))
    bench.mark()
    bench.run(1.0)
    assert bench.driver_frames() == []
    bench.inject(PortChange())
    bench.until(lambda: bench.state == "DISABLED")


def test_a_cycle_that_raises_ends_the_driver_and_the_drives_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = ComponentBench()
    bench.moving()
    monkeypatch.setattr(bench.driver._drives, "collect", _breaks)
    bench.until(lambda: DRIVER in bench.runner.exits, 0.1)
    assert bench.runner.exits[DRIVER].code == EXIT_BROKEN
    bench.run(0.3)
    assert bench.rests()
    for drive in bench.drives.bus.drives.values():
        assert drive.error_code == 0x8130


def test_the_same_seed_gives_the_same_frames() -> None:
    def frames(seed: int) -> Any:
        bench = ComponentBench(seed=seed)
        bench.moving()
        return bench.frames

    one = frames(1)
    assert frames(1) == one
    assert frames(2) != one
