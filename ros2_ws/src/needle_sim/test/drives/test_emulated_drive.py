"""Motion of the emulated drives, commanded through PyPI canopen."""

from __future__ import annotations

import itertools

import pytest

from needle_sim.drives.cia402 import PowerState, next_state

from .master import CSP, PP, ROTATION, Master

# Shutdown, switch on, enable operation, disable voltage, quick stop: state to the states after
# each, as in the figure of CiA 402.
WORDS = (0x06, 0x07, 0x0F, 0x00, 0x02)
WAYS = {
    0x00: (0x00, 0x00, 0x00, 0x00, 0x00),
    0x40: (0x21, 0x40, 0x40, 0x40, 0x40),
    0x21: (0x21, 0x23, 0x27, 0x40, 0x40),
    0x23: (0x21, 0x23, 0x27, 0x40, 0x40),
    0x27: (0x21, 0x23, 0x27, 0x40, 0x07),
    0x07: (0x07, 0x07, 0x27, 0x40, 0x07),
    0x0F: (0x0F, 0x0F, 0x0F, 0x0F, 0x0F),
    0x08: (0x08, 0x08, 0x08, 0x08, 0x08),
}


def run_at(master: Master, counts_per_sync: int) -> int:
    """Move at a constant speed for ten SYNCs; return the position of the motor."""
    start = master.read(0x6064)
    for k in range(1, 11):
        master.target(start + counts_per_sync * k)
        master.sync()
    return master.read(0x6064)


# ---- the power state ---------------------------------------------------------------------------


def test_the_power_state_follows_the_standard() -> None:
    for state in PowerState:
        assert tuple(next_state(state, word).value for word in WORDS) == WAYS[state.value]


def test_an_enabled_drive_moves_at_once_to_an_old_target(master: Master) -> None:
    # Like a real drive: the driver must first set the target to the present position.
    master.target(500)
    master.write(0x6060, 0, CSP, 1)
    master.control(0x06, 0x07, 0x0F)
    master.sync(2)
    assert master.read(0x6064) == 500


# ---- cyclic synchronous position ---------------------------------------------------------------


def test_a_set_point_is_reached_a_sync_later_and_motion_ends_there(master: Master) -> None:
    master.enable(CSP)
    master.target(800)
    master.sync()
    assert master.read(0x6064) == 0
    master.wait(0.01)
    assert master.read(0x6064) == pytest.approx(400, abs=40)
    # Without another SYNC the motion continues and ends on the drive's clock.
    master.wait(1.0)
    assert master.read(0x6064) == master.true_counts() == 800


# ---- profile positions, homing, limit switches -----------------------------------------------


def test_profile_position_ends_at_the_target_in_the_time_of_a_trapezoid(master: Master) -> None:
    speed, ramp, at = 40_000, 400_000, 0
    for index, value in ((0x6081, speed), (0x6083, ramp), (0x6084, ramp)):
        master.write(index, 0, value, 4, ROTATION)
    master.enable(PP, ROTATION)
    for target in (1, 8, -1_000, 10_000):
        master.target(target, ROTATION)
        master.control(0x0F, 0x1F, node=ROTATION)
        assert master.status(ROTATION) & 0x1000
        syncs, fastest = 0, 0
        while not master.status(ROTATION) & 0x400:
            master.sync()
            syncs += 1
            fastest = max(fastest, abs(master.read(0x606C, node=ROTATION)))
            assert syncs < 1000
        distance, at = abs(target - at), target
        if distance > speed**2 / ramp:
            time = distance / speed + speed / ramp
        else:
            time = 2.0 * (distance / ramp) ** 0.5
        assert syncs * 0.02 == pytest.approx(time, abs=0.03)
        assert fastest <= speed
        assert master.read(0x6064, node=ROTATION) == target


@pytest.mark.parametrize("start", [2_345.5, -1.0, -5_000.0])
def test_homing_finds_the_edge_of_the_switch(start: float) -> None:
    master = Master(start=start)
    # The drive counts from its position at power-up.
    assert master.read(0x6064) == 0
    master.home()
    # It rests a braking distance off the edge and counts from the edge.
    assert 0 <= master.read(0x6064) < 100
    assert master.true_counts() == pytest.approx(master.read(0x6064), abs=0.5)


def test_homing_to_the_positive_switch_with_an_offset_and_at_the_present_position() -> None:
    master = Master(start=0.249 * 2e7)
    master.write(0x607C, 0, 100, 4)
    master.home(18)
    assert master.true_counts() < 0.25 * 2e7
    assert master.read(0x6064) == pytest.approx(master.true_counts() - 0.25 * 2e7 - 100, abs=1)
    assert master.home(37, ROTATION) <= 1
    assert master.true_counts("rotation") == 0.0


def test_a_limit_switch_stops_the_axis(master: Master) -> None:
    master.write(0x6085, 0, 1_000_000, 4)
    master.enable(CSP)
    for k in range(1, 40):
        master.target(-800 * k)
        master.sync()
    assert -2_000 < master.true_counts() < 0
    assert master.status() & 0x800
    assert master.read(0x60FD) == 0b101
    at = master.true_counts()
    master.sync(10)
    assert master.true_counts() == at
    # The opposite direction is free.
    master.target(0)
    master.sync(3)
    assert master.true_counts() == 0.0


# ---- stopping ----------------------------------------------------------------------------------


def test_a_quick_stop_brakes_on_its_ramp_and_stays(master: Master) -> None:
    master.write(0x605A, 0, 6, 2)
    master.write(0x6085, 0, 1_000_000, 4)
    master.enable(CSP)
    before = run_at(master, 800)
    master.control(0x02)
    master.sync(10)
    # v^2 / (2 a) with 40,000 counts/s and 1,000,000 counts/s^2.
    rest = master.read(0x6064)
    assert rest - before == pytest.approx(800, abs=1)
    assert master.state() == 0x07
    # Motion continues only with a new set-point: the old one is still stored.
    master.target(rest)
    master.control(0x0F)
    master.sync(10)
    assert (master.state(), master.read(0x6064)) == (0x27, rest)


# ---- limits, faults ----------------------------------------------------------------------------


def test_a_target_beyond_the_software_limits_of_a_homed_drive_is_clipped(master: Master) -> None:
    master.write(0x607D, 2, 1_000, 4)
    master.home()
    master.enable(CSP)
    master.target(1_001)
    master.sync(3)
    assert (master.state(), master.read(0x6064)) == (0x27, 1_000)
    assert master.status() & 0x800


def test_a_stalled_motor_is_a_following_error(master: Master) -> None:
    master.write(0x6065, 0, 2_000, 4)
    master.write(0x6066, 0, 40, 2)
    master.write(0x6085, 0, 1_000_000, 4)
    master.enable(CSP)
    run_at(master, 400)
    master.bus.stall("insertion")
    at = master.true_counts()
    master.received.clear()
    for k in itertools.count(1):
        master.target(round(at) + 400 * k)
        master.sync()
        if master.state() == 0x08:
            break
        assert k < 20
    # Each set-point is reached a SYNC later; 2,000 counts at 400, 40 ms of patience, 20 ms of ramp.
    assert k in (9, 10)
    assert master.frames(0x81) == [bytes([0x11, 0x86, 0x21, 0, 0, 0, 0, 0])]
    master.bus.restore(master.now)
    master.sync(10)
    assert master.true_counts() == at


def test_a_fault_brakes_and_is_reset_by_a_rising_edge(master: Master) -> None:
    master.write(0x6085, 0, 1_000_000, 4)
    master.enable(CSP)
    before = run_at(master, 800)
    master.bus.fail("insertion", 0x5530)
    assert master.state() == 0x0F
    master.sync(5)
    assert master.state() == 0x08
    assert master.read(0x6064) - before == pytest.approx(800, abs=1)
    master.control(0x0F)
    assert master.state() == 0x08
    master.received.clear()
    master.control(0x80)
    assert master.state() == 0x40
    assert master.frames(0x81) == [bytes(8)]
    master.bus.fail("insertion", 0x5530)
    master.control(0x80)
    assert master.state() == 0x08
