"""Procedures of the emulated drives: profile positions, homing, limit switches."""

from __future__ import annotations

import pytest

from .master import CSP, HM, PP, ROTATION, Master


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


def test_the_next_profile_target_waits_for_the_first_and_relative_ones_add(
    master: Master,
) -> None:
    master.enable(PP)
    for relative in (1_000, 500):
        master.target(relative)
        master.control(0x0F, 0x5F)
    master.sync(200)
    # Both relative to where the drive stood when they came.
    assert master.read(0x6064) == 500


@pytest.mark.parametrize("start", [2_345.5, -1.0, -5_000.0])
def test_homing_finds_the_edge_of_the_switch(start: float) -> None:
    master = Master(start=start)
    # It counts from its position at power-up.
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


def test_homing_can_be_broken_off() -> None:
    master = Master(start=200_000.0)
    master.write(0x6098, 0, 17, 1)
    master.write(0x6099, 1, 40_000, 4)
    master.enable(HM)
    master.control(0x1F)
    master.sync(20)
    master.control(0x0F)
    master.sync(30)
    at = master.read(0x6064)
    master.sync(10)
    assert at == master.read(0x6064) < 0
    assert not master.status() & 0x1000


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
