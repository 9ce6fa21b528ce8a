"""The ideal axis, and the bench that it moves."""

from __future__ import annotations

import pytest

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.procedure import run_at_once
from needle_sim.devices import SimulatedAxis

PERIOD = 0.02


def powered(name: str = "insertion", position: float = 0.0) -> SimulatedAxis:
    axis = SimulatedAxis(name, position=position)
    run_at_once(axis.configure())
    axis.power(True)
    return axis


def test_an_axis_reaches_its_target_exactly_and_in_time_both_ways() -> None:
    axis = powered()
    for target in (0.001, -0.002):
        speed = abs(target - axis.position) / 0.2
        axis.start_move(target, speed)
        for _ in range(9):
            axis.advance(PERIOD)
        assert axis.position != target
        assert abs(axis.poll(0.0).velocity) == pytest.approx(speed)
        axis.advance(PERIOD)
        assert axis.position == target
        axis.advance(PERIOD)
        assert (axis.poll(0.0).velocity, axis.poll(0.0).moving) == (0.0, False)


def test_an_axis_that_is_off_stopped_or_at_fault_does_not_move() -> None:
    axis = SimulatedAxis("insertion")
    with pytest.raises(AxisError, match="insertion axis cannot move: not powered"):
        axis.start_move(1.0, 1.0)
    axis.power(True)
    axis.start_move(1.0, 1.0)
    axis.stop()
    axis.advance(PERIOD)
    axis.start_move(1.0, 1.0)
    axis.power(False)
    axis.advance(PERIOD)
    axis.power(True)
    axis.advance(PERIOD)
    axis.start_move(1.0, 1.0)
    axis.fault = "stalled"
    axis.advance(PERIOD)
    assert axis.position == 0.0
    with pytest.raises(AxisError, match="stalled"):
        run_at_once(axis.home(1.0))
    run_at_once(axis.reset())
    run_at_once(axis.home(1.0))
    assert (axis.poll(7.0).homed, axis.poll(7.0).time) == (True, 7.0)
