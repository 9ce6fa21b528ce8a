"""The driver's component on the emulated drives: what it does, faults, and who stops what."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from typing import Any

import pytest

from needle_core.can_frame import CAN
from needle_core.runners.faults import delay, silence
from needle_device_driver.cia402 import cia402_axis
from needle_device_driver.device_driver import EXIT_BROKEN

from .component_bench import DRIVER, DRIVES, ComponentBench

HEARTBEAT_LOST = 0x8130
UNITS = (0x608F, 0x60A8, 0x60A9, 0x60AA)


def test_it_sets_the_drives_up_homes_and_moves_them_in_even_cycles() -> None:
    bench = ComponentBench(drives={"insertion_start": 0.001})
    bench.home()
    bench.arm()
    bench.mark()
    bench.step(0.002, 0.5, 1.0)
    bench.until(lambda: bench.outcomes)
    assert bench.outcomes == ["succeeded"]
    assert bench.places[0] == pytest.approx(0.002, abs=1e-5)
    assert bench.places[1] == pytest.approx(0.5, abs=2e-3)
    assert bench.status.simulated
    assert bench.status.watchdog_trips == 0
    times = [time for time, _ in bench.sent(0x80)]
    gaps = [later - before for before, later in itertools.pairwise(times)]
    assert len(times) > 50
    assert 0.0195 < min(gaps) <= max(gaps) < 0.0205


# ---- speeds of emulated drives -----------------------------------------------------------------


def test_drives_that_take_speeds_in_rpm_and_say_so_home_at_the_speed_that_they_are_told() -> None:
    bench = ComponentBench(drives={"rpm": True, "insertion_start": 0.002})
    bench.home()
    # 2 mm at 2 mm/s and the way off the switch.
    assert 1.0 < bench.until(lambda: bench.status.homed) < 1.6
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
    bench.until(lambda: bench.status.state == "FAULT")
    assert "insertion axis: moves at 150 mm/s, at most 3.5 mm/s" in bench.status.fault
    bench.run(0.5)
    assert 0.1 - bench.places[0] < 0.008
    assert bench.rests()


@pytest.mark.parametrize("start", [-0.0005, 0.0, 0.00003])
def test_homing_from_anywhere_is_no_alarm(start: float) -> None:
    bench = ComponentBench(drives={"insertion_start": start}, max_depth=0.01)
    bench.home()
    bench.until(lambda: bench.status.homed)
    assert bench.status.state == "DISABLED"


@pytest.mark.parametrize(("lag", "late"), [(0.0, 0.012), (0.02, 0.004)])
def test_steps_that_are_broken_off_and_go_on_are_no_alarm(lag: float, late: float) -> None:
    rng = random.Random(3)
    bench = ComponentBench(fault=delay("can", late), drives={"insertion_lag": lag})
    bench.home()
    bench.arm()
    for _ in range(3):
        bench.step(0.001, rng.uniform(-0.6, 0.6), rng.choice((0.2, 0.4, 1.0)))
        bench.run(rng.uniform(0.2, 0.8))
        bench.person.pressed = False
        bench.run(rng.uniform(0.05, 0.3))
        bench.person.pressed = True
        bench.run(0.1)
    assert bench.status.state in ("HOLDING", "MOVING"), bench.status.fault
    assert bench.places[0] > 0.001


# ---- faults ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "fault", "within"),
    [
        ("stall insertion", "following error", 0.4),
        ("reboot rotation", "no reply", 0.15),
        ("emcy insertion 0x2310", "over-current", 0.05),
        ("hang insertion", "no reply", 0.15),
        ("cut_bus", "no reply", 0.15),
    ],
)
def test_a_fault_of_one_drive_on_command_stops_both(line: str, fault: str, within: float) -> None:
    bench = ComponentBench()
    bench.moving()
    at = bench.places
    bench.say(line)
    assert any(f"on command: {line}" in text for text in bench.logs)
    assert bench.until(lambda: bench.status.state == "FAULT", 1.0) < within
    assert fault in bench.status.fault
    bench.run(0.2)
    # 2 mm/s and 0.5 rad/s until the fault is known, and the ramps.
    assert bench.places[0] - at[0] < 0.002 * (within + 0.07)
    assert bench.places[1] - at[1] < 0.5 * (within + 0.07)
    assert bench.rests()
    assert bench.outcomes[-1].startswith("aborted: ")


def test_after_a_fault_a_reset_lets_it_go_on() -> None:
    bench = ComponentBench()
    bench.moving()
    bench.say("reboot rotation")
    bench.release()
    bench.run(0.5)
    assert bench.call("reset").success
    assert not bench.status.homed
    assert bench.rests()
    bench.moving()
    bench.until(lambda: bench.outcomes[-1] == "succeeded")


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
    assert bench.error_codes == {HEARTBEAT_LOST}
    bench.until(lambda: bench.status.state == "FAULT", 2.0)
    assert "heartbeat was missed" in bench.status.fault
    assert bench.places == stopped


# ---- the end, and what is broken ---------------------------------------------------------------


def test_an_end_brings_the_axes_to_rest_and_releases_the_drives_watchdogs() -> None:
    bench = ComponentBench()
    bench.moving()
    bench.runner.stop(DRIVER)
    bench.until(lambda: bench.ended, 2.0)
    assert bench.ended == (0, "")
    assert bench.rests()
    assert bench.error_codes == {0}
    for drive in bench.drives.bus.drives.values():
        assert drive.state.name == "SWITCH_ON_DISABLED"


def test_drives_that_are_not_there_end_it_and_late_ones_are_set_up() -> None:
    bench = ComponentBench(fault=silence(DRIVES, 0.0, math.inf), connect_timeout=1.0)
    bench.until(lambda: bench.ended, 8.0)
    code, text = bench.ended or (0, "")
    assert code == 2
    assert "node 1 does not answer" in text
    late = ComponentBench(fault=silence(DRIVES, 0.0, 1.0), connect_timeout=3.0)
    late.until(lambda: late.status.state == "DISABLED", 8.0)


def _breaks(*_: Any) -> Any:
    raise ZeroDivisionError("planted")


def _a_handler(bench: ComponentBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.moving()
    monkeypatch.setattr(bench.driver.supervisor, "submit", _breaks)
    bench.step()


def _an_order(bench: ComponentBench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.set_up()
    monkeypatch.setattr(cia402_axis, "write_homing", _breaks)
    assert bench.call("home").text == "called off: internal error"


@pytest.mark.parametrize("breaks", [_a_handler, _an_order])
def test_a_handler_or_order_that_raises_stops_both_axes_until_a_reset(
    breaks: Callable[[ComponentBench, pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = ComponentBench()
    breaks(bench, monkeypatch)
    bench.release()
    assert "internal error: ZeroDivisionError: planted" in bench.status.fault
    assert bench.ended is None
    assert bench.rests()
    assert bench.call("reset").success


def test_a_cycle_that_raises_ends_the_driver_and_the_drives_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = ComponentBench()
    bench.moving()
    monkeypatch.setattr(bench.driver._drives, "collect", _breaks)
    bench.until(lambda: bench.ended, 0.1)
    assert bench.runner.exits[DRIVER].code == EXIT_BROKEN
    bench.run(0.3)
    assert bench.rests()
    assert bench.error_codes == {HEARTBEAT_LOST}


# ---- the port ----------------------------------------------------------------------------------


def test_a_lost_port_stops_both_and_a_reset_opens_it_anew() -> None:
    bench = ComponentBench()
    bench.moving()
    at = bench.places
    bench.runner.lose_port(DRIVER, CAN, "unplugged")
    # The driver needs no cycle of its own.
    assert bench.until(lambda: bench.status.state == "FAULT") < 0.01
    assert "link virtual can is lost: unplugged" in bench.status.fault
    bench.mark()
    bench.release()
    assert bench.sent() == []
    assert bench.places[0] - at[0] < 0.002 * 0.05
    assert bench.error_codes == {HEARTBEAT_LOST}
    assert "cannot open virtual can: unplugged" in bench.call("reset").text
    bench.runner.open_port(DRIVER, CAN)
    bench.run(0.02)
    assert bench.call("reset").success
    bench.moving()
    bench.until(lambda: bench.outcomes[-1] == "succeeded")


def test_a_port_that_opens_in_time_is_waited_for() -> None:
    bench = ComponentBench()
    bench.runner.lose_port(DRIVER, CAN, "no such file")
    bench.run(1.0)
    assert bench.sent() == []
    assert bench.status.state == "UNCONFIGURED"
    bench.runner.open_port(DRIVER, CAN)
    bench.until(lambda: bench.status.state == "DISABLED")
