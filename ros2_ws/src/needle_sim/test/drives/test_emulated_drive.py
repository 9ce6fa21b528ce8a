"""What the emulated drives do with their motors, told to them through PyPI canopen."""

from __future__ import annotations

import itertools
import random

import canopen
import pytest

from needle_sim.bus.object_dictionary import Abort
from needle_sim.drives.drive_motion import LimitAction
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_sim.drives.power_state import TRANSITIONS, PowerState, next_state

from .master import CSP, INSERTION, MASTER, PP, ROTATION, Master, settings

ORDERS = {
    "shutdown": 0x06,
    "switch on": 0x07,
    "enable": 0x0F,
    "disable voltage": 0,
    "quick stop": 2,
}


# ---- the power state ---------------------------------------------------------------------------


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("state", PowerState)
def test_power_state_goes_where_the_standard_says(state: PowerState, order: str) -> None:
    s = PowerState
    ways = {
        (s.SWITCH_ON_DISABLED, "shutdown"): s.READY_TO_SWITCH_ON,
        (s.READY_TO_SWITCH_ON, "switch on"): s.SWITCHED_ON,
        (s.READY_TO_SWITCH_ON, "enable"): s.OPERATION_ENABLED,
        (s.READY_TO_SWITCH_ON, "disable voltage"): s.SWITCH_ON_DISABLED,
        (s.READY_TO_SWITCH_ON, "quick stop"): s.SWITCH_ON_DISABLED,
        (s.SWITCHED_ON, "enable"): s.OPERATION_ENABLED,
        (s.SWITCHED_ON, "shutdown"): s.READY_TO_SWITCH_ON,
        (s.SWITCHED_ON, "disable voltage"): s.SWITCH_ON_DISABLED,
        (s.SWITCHED_ON, "quick stop"): s.SWITCH_ON_DISABLED,
        (s.OPERATION_ENABLED, "switch on"): s.SWITCHED_ON,
        (s.OPERATION_ENABLED, "shutdown"): s.READY_TO_SWITCH_ON,
        (s.OPERATION_ENABLED, "disable voltage"): s.SWITCH_ON_DISABLED,
        (s.OPERATION_ENABLED, "quick stop"): s.QUICK_STOP_ACTIVE,
        (s.QUICK_STOP_ACTIVE, "disable voltage"): s.SWITCH_ON_DISABLED,
        (s.QUICK_STOP_ACTIVE, "enable"): s.OPERATION_ENABLED,
    }
    assert next_state(state, ORDERS[order]) is ways.get((state, order), state)
    assert len(ways) == len(TRANSITIONS)


def test_switching_on_and_off_moves_nothing(master: Master) -> None:
    master.enable(CSP)
    assert master.state() == 0x27
    master.sync(5)
    master.control(0x07)
    assert master.state() == 0x23
    master.control(0x06)
    assert master.state() == 0x21
    master.control(0x00)
    assert master.state() == 0x40
    assert master.true_counts() == 0.0


# ---- cyclic synchronous position ---------------------------------------------------------------


def test_set_point_of_a_sync_is_reached_at_the_next(master: Master) -> None:
    master.enable(CSP)
    master.target(800)
    master.sync()
    assert master.read(0x6064) == 0
    master.sync()
    assert master.read(0x6064) == 800
    # Without another one it stays there: motion ends by itself.
    master.sync(50)
    assert master.true_counts() == 800.0


def test_random_set_points_add_up_to_the_count(master: Master) -> None:
    rng = random.Random(7)
    master.enable(CSP)
    at = 0
    for _ in range(2000):
        at += rng.randrange(0, 2000)
        master.target(at)
        master.sync()
    master.sync()
    assert master.read(0x6064) == at
    assert master.true_counts() == at


def test_runs_at_once_to_an_old_target_when_enabled(master: Master) -> None:
    # What an honest drive does: a driver must set the target to where it is before.
    master.target(500)
    master.write(0x6060, 0, CSP, 1)
    master.control(0x06, 0x07, 0x0F)
    master.sync(2)
    assert master.read(0x6064) == 500


def test_steady_clock_moves_without_sync_and_ends_by_itself() -> None:
    master = Master()
    master.enable(CSP)
    master.target(800)
    master.sync()
    master.wait(0.01)
    assert master.read(0x6064) == pytest.approx(400, abs=40)
    master.wait(1.0)
    assert master.read(0x6064) == 800


def test_lagging_motor_follows_and_arrives_exactly() -> None:
    master = Master(lag=0.005)
    master.enable(CSP)
    for k in range(1, 26):
        master.target(800 * k)
        master.sync()
        if k > 5:
            # v tau = 40 counts/ms x 5 ms, but for the last millisecond's share.
            assert master.read(0x60F4) == pytest.approx(180, abs=30)
    master.sync(4)
    assert master.read(0x6064) == 800 * 25


# ---- stopping ----------------------------------------------------------------------------------


def run_at(master: Master, counts_per_sync: int, syncs: int = 10) -> int:
    start = master.read(0x6064)
    for k in range(1, syncs + 1):
        master.target(start + counts_per_sync * k)
        master.sync()
    return master.read(0x6064)


def test_quick_stop_brakes_on_its_ramp_and_stays(master: Master) -> None:
    master.write(0x605A, 0, 6, 2)
    master.write(0x6085, 0, 1_000_000, 4)
    master.enable(CSP)
    before = run_at(master, 800)
    master.control(0x02)
    master.sync(10)
    # v^2 / (2 a) with 40,000 counts/s and 1,000,000 counts/s^2.
    assert master.read(0x6064) - before == pytest.approx(800, abs=1)
    assert master.state() == 0x07
    # Operation goes on only with a set-point: the old one is still there.
    rest = master.read(0x6064)
    master.target(rest)
    master.control(0x0F)
    master.sync(10)
    assert (master.state(), master.read(0x6064)) == (0x27, rest)


def test_quick_stop_with_option_2_switches_off(master: Master) -> None:
    master.enable(CSP)
    run_at(master, 800)
    master.control(0x02)
    master.sync(30)
    assert master.state() == 0x40


def test_disabling_brakes_first(master: Master) -> None:
    master.write(0x605B, 0, 1, 2)
    master.write(0x6084, 0, 500_000, 4)
    master.enable(CSP)
    before = run_at(master, 800)
    master.control(0x06)
    assert master.state() == 0x27
    master.sync(20)
    assert master.state() == 0x21
    assert master.read(0x6064) - before == pytest.approx(1600, abs=1)


def test_halt_stops_and_its_release_goes_on(master: Master) -> None:
    master.enable(PP)
    master.target(20_000)
    master.control(0x1F)
    master.sync(20)
    master.control(0x11F)
    master.sync(30)
    stopped = master.read(0x6064)
    master.sync(10)
    assert 0 < stopped == master.read(0x6064) < 20_000
    master.control(0x1F)
    master.sync(200)
    assert master.read(0x6064) == 20_000


# ---- limits, faults ----------------------------------------------------------------------------


@pytest.mark.parametrize("action", LimitAction)
def test_software_limits(action: LimitAction) -> None:
    master = Master(limit_action=action)
    master.write(0x607D, 1, 0, 4)
    master.write(0x607D, 2, 1_000, 4)
    master.home()
    master.enable(CSP)
    if action is LimitAction.ABORT:
        with pytest.raises(canopen.SdoAbortedError) as refused:
            master.target(1_001)
        assert refused.value.code == Abort.VALUE_TOO_HIGH
        assert master.status() & 0x800
    else:
        master.target(1_001)
    master.sync(3)
    if action is LimitAction.CLAMP:
        assert master.status() & 0x800
        assert (master.state(), master.read(0x6064)) == (0x27, 1_000)
    elif action is LimitAction.FAULT:
        assert (master.state(), master.read(0x603F)) == (0x08, 0x8612)
        assert master.read(0x6064) < 100
    else:
        assert (master.state(), master.read(0x6064) < 100) == (0x27, True)


def test_stalled_motor_is_a_following_error(master: Master) -> None:
    master.write(0x6065, 0, 2_000, 4)
    master.write(0x6066, 0, 40, 2)
    master.write(0x6085, 0, 1_000_000, 4)
    master.enable(CSP)
    run_at(master, 400)
    master.bus.stall("insertion")
    at = master.true_counts()
    master.heard.clear()
    for k in itertools.count(1):
        master.target(round(at) + 400 * k)
        master.sync()
        if master.state() == 0x08:
            break
        assert k < 20
    # Each set-point is reached a SYNC later; 2,000 counts at 400, 40 ms of patience, 20 ms of ramp.
    assert k in (9, 10)
    assert master.frames(0x81) == [bytes([0x11, 0x86, 0x21, 0, 0, 0, 0, 0])]
    assert master.true_counts() == at
    master.bus.restore(master.now)
    master.sync(10)
    assert master.true_counts() == at


def test_fault_brakes_then_wants_a_rising_edge(master: Master) -> None:
    master.write(0x6085, 0, 1_000_000, 4)
    master.enable(CSP)
    before = run_at(master, 800)
    master.bus.emergency("insertion", 0x5530)
    assert master.state() == 0x0F
    master.sync(5)
    assert master.state() == 0x08
    assert master.read(0x6064) - before == pytest.approx(800, abs=1)
    master.control(0x0F)
    assert master.state() == 0x08
    master.heard.clear()
    master.control(0x80)
    assert master.state() == 0x40
    assert master.frames(0x81) == [bytes(8)]
    master.bus.emergency("insertion", 0x5530)
    master.control(0x80)
    assert master.state() == 0x08


def test_reboot_stops_forgets_home_and_counts_anew(master: Master) -> None:
    master.home()
    master.enable(CSP)
    run_at(master, 800)
    at = master.true_counts()
    master.bus.reboot("insertion", master.now)
    master.sync(5)
    assert master.true_counts() == at
    master.heard.clear()
    master.wait(0.31)
    assert master.frames(0x701) == [b"\0"]
    assert (master.read(0x6064), master.state()) == (0, 0x40)


def test_hung_drive_is_silent_and_ends_at_its_set_point(master: Master) -> None:
    master.write(0x1017, 0, 30, 2)
    master.enable(CSP)
    run_at(master, 800)
    master.bus.hang("insertion")
    master.heard.clear()
    master.target(0, ROTATION)
    master.sync(20)
    assert not [f for f in master.heard if f.identifier & 0x7F == INSERTION]
    assert master.true_counts() == 8_000.0
    master.bus.restore(master.now)
    assert master.state() == 0x27


def test_drive_that_comes_back_has_missed_the_heartbeat_first(master: Master) -> None:
    master.write(0x1016, 1, MASTER << 16 | 300, 4)
    master.network.send_message(0x700 + MASTER, b"\5")
    master.enable(CSP)
    before = run_at(master, 800)
    master.bus.hang("insertion")
    master.sync(20)
    at = master.true_counts()
    assert at == before + 800
    master.bus.restore(master.now)
    master.network.send_message(0x700 + MASTER, b"\5")
    master.target(round(at) + 800)
    master.sync(5)
    assert (master.state(), master.read(0x603F)) == (0x08, 0x8130)
    assert master.true_counts() == at


def test_cut_bus_loses_frames_both_ways() -> None:
    master = Master()
    master.write(0x1017, 0, 30, 2)
    master.write(0x1016, 1, MASTER << 16 | 100, 4)
    master.network.send_message(0x700 + MASTER, b"\5")
    master.enable(CSP)
    master.bus.is_cut = True
    master.heard.clear()
    master.network.send_message(0x601, b"\x23\x7a\x60\0\x20\x03\0\0")
    master.network.send_message(0x80, b"")
    master.wait(0.5)
    assert master.heard == []
    assert master.true_counts() == 0.0
    # The drive's own watchdog has seen it.
    assert master.bus.drives["insertion"].state is PowerState.FAULT


def test_two_drives_of_one_id_are_refused() -> None:
    drive = settings("insertion", LimitAction.CLAMP)
    with pytest.raises(ValueError, match="node id 1"):
        EmulatedBus(drive, drive, 0.0)
