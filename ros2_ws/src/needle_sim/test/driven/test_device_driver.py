"""The driver's component on the emulated drives: what it does, faults, and who stops what."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from typing import Any

import pytest

from needle_core.component import PortChange
from needle_core.runners.faults import delay, silence
from needle_device_driver.cia402 import cia402_axis
from needle_device_driver.device_driver import EXIT_BROKEN

from .component_bench import DRIVER, DRIVES, ComponentBench

HEARTBEAT_LOST = 0x8130
UNITS = (0x608F, 0x60A8, 0x60A9, 0x60AA)


def error_codes(bench: ComponentBench) -> set[int]:
    return {drive.error_code for drive in bench.drives.bus.drives.values()}


def test_it_sets_the_drives_up_homes_and_moves_them_in_even_cycles() -> None:
    bench = ComponentBench(drives={"insertion_start": 0.001})
    bench.ready()
    bench.mark()
    bench.step(0.002, 0.5, 1.0)
    bench.until(lambda: bool(bench.person.outcomes))
    assert bench.person.outcomes == ["succeeded"]
    assert bench.places[0] == pytest.approx(0.002, abs=1e-5)
    assert bench.places[1] == pytest.approx(0.5, abs=2e-3)
    assert bench.person.status["simulated"] == "true"
    assert bench.person.status["watchdog_trips"] == "0"
    times = [time for time, _ in bench.sent(0x80)]
    gaps = [later - before for before, later in itertools.pairwise(times)]
    assert len(times) > 50
    assert 0.0195 < min(gaps) <= max(gaps) < 0.0205


# ---- speeds of emulated drives -----------------------------------------------------------------


def test_drives_that_take_speeds_in_rpm_and_say_so_home_at_the_speed_that_they_are_told() -> None:
    bench = ComponentBench(drives={"rpm": True, "insertion_start": 0.002})
    bench.home()
    # 2 mm at 2 mm/s and the way off the switch.
    assert 1.0 < bench.until(lambda: bench.person.status["homed"] == "true") < 1.6
    assert bench.places[0] == pytest.approx(0.0, abs=2e-5)


def test_drives_that_take_speeds_in_rpm_and_do_not_say_so_are_stopped_within_8_mm() -> None:
    bench = ComponentBench(
        drives={"rpm": True, "insertion_start": 0.1, "insertion_max_speed": 0.15}
    )
    for drive in bench.drives.bus.drives.values():
        objects = drive._objects
        for key in [key for key in objects._entries if key[0] in UNITS]:
            del objects._entries[key]
        objects._indices.difference_update(UNITS)
    bench.home()
    bench.until(lambda: bench.state == "FAULT")
    assert "insertion axis: moves at 150 mm/s, at most 3.5 mm/s" in bench.fault
    bench.run(0.5)
    assert 0.1 - bench.places[0] < 0.008
    assert bench.rests()


@pytest.mark.parametrize("start", [-0.0005, 0.0, 0.00003])
def test_homing_from_anywhere_is_no_alarm(start: float) -> None:
    bench = ComponentBench(drives={"insertion_start": start}, max_depth=0.01)
    bench.home()
    bench.until(lambda: bench.person.status["homed"] == "true", 10.0)
    assert bench.state == "DISABLED"


@pytest.mark.parametrize(("lag", "late"), [(0.0, 0.012), (0.02, 0.004)])
def test_steps_that_are_broken_off_and_go_on_are_no_alarm(lag: float, late: float) -> None:
    rng = random.Random(3)
    bench = ComponentBench(fault=delay("can", late), drives={"insertion_lag": lag})
    bench.ready()
    for _ in range(3):
        bench.step(0.001, rng.uniform(-0.6, 0.6), rng.choice((0.2, 0.4, 1.0)))
        bench.run(rng.uniform(0.2, 0.8))
        bench.person.pressed = False
        bench.run(rng.uniform(0.05, 0.3))
        bench.person.pressed = True
        bench.run(0.1)
    assert bench.state in ("HOLDING", "MOVING"), bench.fault
    assert bench.places[0] > 0.001


# ---- faults ------------------------------------------------------------------------------------

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
    assert error_codes(bench) == {HEARTBEAT_LOST}
    bench.until(lambda: bench.state == "FAULT", 2.0)
    assert "heartbeat was missed" in bench.fault
    assert bench.places == stopped


# ---- the end, and what is broken ---------------------------------------------------------------


def test_an_end_brings_the_axes_to_rest_and_releases_the_drives_watchdogs() -> None:
    bench = ComponentBench()
    bench.moving()
    bench.runner.stop(DRIVER)
    bench.until(lambda: DRIVER in bench.runner.exits, 2.0)
    assert bench.runner.exits[DRIVER].code == 0
    assert bench.rests()
    assert error_codes(bench) == {0}
    for drive in bench.drives.bus.drives.values():
        assert drive.state.name == "SWITCH_ON_DISABLED"


def test_drives_that_are_not_there_end_it_and_late_ones_are_set_up() -> None:
    bench = ComponentBench(fault=silence(DRIVES, 0.0, math.inf), connect_timeout=1.0)
    bench.until(lambda: DRIVER in bench.runner.exits, 8.0)
    assert bench.runner.exits[DRIVER].code == 2
    assert "node 1 does not answer" in bench.runner.exits[DRIVER].text
    late = ComponentBench(fault=silence(DRIVES, 0.0, 1.0), connect_timeout=3.0)
    late.until(lambda: late.state == "DISABLED", 8.0)


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
    assert error_codes(bench) == {HEARTBEAT_LOST}


# ---- the port ----------------------------------------------------------------------------------


def test_a_lost_port_stops_both_and_a_reset_opens_it_anew() -> None:
    bench = ComponentBench()
    bench.moving()
    at = bench.places
    bench.inject(PortChange("unplugged"))
    # The person acts every 0.01 s; the driver then needs no cycle of its own.
    assert bench.until(lambda: bench.state == "FAULT") < 0.015
    assert "link virtual can is lost: unplugged" in bench.fault
    bench.mark()
    bench.person.pressed = False
    bench.run(0.2)
    assert bench.sent() == []
    assert bench.places[0] - at[0] < 0.002 * 0.05
    assert error_codes(bench) == {HEARTBEAT_LOST}
    assert "cannot open virtual can: unplugged" in bench.call("reset").text
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
    assert bench.sent() == []
    bench.inject(PortChange())
    bench.until(lambda: bench.state == "DISABLED")
