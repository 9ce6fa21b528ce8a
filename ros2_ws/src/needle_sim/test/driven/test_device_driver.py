"""The driver's component on the emulated drives: what it does, faults, and who stops what."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from needle_core.errors import UserError
from needle_core.runners.faults import delay
from needle_sim.drive_emulator import ADAPTER
from needle_sim.drives.fault_commands import PlugOrder

from .component_bench import DRIVER, DRIVES, ComponentBench, losing

HEARTBEAT_LOST = 0x8130
LIMITS, HOMING_SPEEDS, DEVICE_TYPE = 0x607D, 0x6099, 0x1000
UNITS = (0x608F, 0x60A8, 0x60A9, 0x60AA)


def test_it_sets_the_drives_up_homes_and_moves_them_in_even_cycles() -> None:
    bench = ComponentBench(drives={"insertion_start": 0.001})
    bench.home()
    bench.arm()
    bench.mark()
    bench.command(0.002, 0.5, 1.0)
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
        bench.command(0.001, rng.uniform(-0.6, 0.6), rng.choice((0.2, 0.4, 1.0)))
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


def test_lines_that_are_no_commands_are_named_and_do_nothing() -> None:
    bench = ComponentBench()
    bench.until(lambda: bench.status.state == "DISABLED")
    bench.logs.clear()
    bad = (
        "explode",
        "stall",
        "stall both",
        "stall insertion now",
        "emcy insertion x",
        "emcy rotation 0x10000",
        "cut_bus now",
    )
    bench.say(*bad)
    assert [text.split("'")[1] for text in bench.logs] == list(bad)
    bench.say("unplug", "restore")
    assert [*itertools.chain(*bench.heard(ADAPTER))] == [PlugOrder.OUT, PlugOrder.IN]
    bench.run(0.5)
    assert bench.status.state == "DISABLED"
    assert bench.error_codes == {0}


def test_drives_that_cannot_be_are_refused() -> None:
    for bad in ({"insertion_node_id": 2}, {"limit_action": "ignore"}, {"insertion_start": 0.3}):
        with pytest.raises(UserError, match=r"node id|one of|beyond"):
            ComponentBench(drives=bad)


# ---- both drives -------------------------------------------------------------------------------


def test_both_drives_are_asked_side_by_side_and_homing_begins_when_both_have_taken_limits() -> None:
    lost = [math.inf]
    bench = ComponentBench(drives={"insertion_start": 0.002}, fault=losing(0x582, lost))
    bench.set_up()

    def times(cob_id: int) -> list[float]:
        return [time for time, frame in bench.sent(cob_id) if bench.entry(frame)[0] != DEVICE_TYPE]

    assert times(0x601)[0] < times(0x602)[-1]
    assert times(0x602)[0] < times(0x601)[-1]
    # The rotation drive's answers are lost for a while: it is asked again.
    lost[0] = bench.runner.now + 0.3
    bench.mark()
    assert bench.call("home").success
    replied = bench.runner.now
    bench.until(lambda: bench.status.homed)
    first = min(time for time, frame in bench.sent(0x201, 0x202) if frame.data[0] & 0x10)
    taken = {
        (frame.identifier, *bench.entry(frame)): time
        for time, frame in bench.sent(0x581, 0x582, by=DRIVES)
        if frame.data[0] == 0x60
    }
    wanted = list(itertools.product((0x581, 0x582), (LIMITS, HOMING_SPEEDS), (1, 2)))
    assert max(taken[key] for key in wanted) < min(first, replied)
    assert replied > lost[0]


def test_an_emergency_stop_calls_a_set_up_off_until_it_is_released() -> None:
    bench = ComponentBench()
    bench.until(lambda: len(bench.sent(0x601)) > 10)
    bench.press_stop()
    bench.until(lambda: bench.status.state == "ESTOPPED")
    bench.mark()
    bench.run(1.5)
    # It looks whether they are still there, and no more.
    assert {bench.entry(frame)[0] for _, frame in bench.sent(0x601, 0x602)} == {DEVICE_TYPE}
    bench.press_stop(False)
    bench.until(lambda: bench.status.state == "DISABLED")
