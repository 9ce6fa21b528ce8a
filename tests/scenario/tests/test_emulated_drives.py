"""Driver and emulated drives: homing and cycles without faults."""

from __future__ import annotations

import itertools
import random
from typing import Any

import pytest

from needle_core.can_frame import CAN
from needle_core.runners.transport import Arrival, Arrivals, Link
from needle_device_driver.conformance.rig import DRIVER
from scenario.transport_faults import delay
from scenario.virtual_rig import VirtualRig

SYNC = 0x080


def test_a_step_moves_in_equal_cycles_to_its_target() -> None:
    syncs: list[float] = []

    def watch(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        if (link.topic, link.sender) == (CAN, DRIVER):
            syncs.extend(now for frame in message if frame.identifier == SYNC)
        return (Arrival(0.0, message),)

    rig = VirtualRig(1, faults=(watch,))
    rig.home()
    rig.press()
    syncs.clear()
    stamp = rig.command(0.002, 0.5, 1.0)
    rig.until(lambda: stamp in rig.hand.results, "the result")
    assert rig.hand.results[stamp] == "succeeded"
    assert rig.positions == pytest.approx((0.002, 0.5), abs=1e-3)
    assert rig.hand.status.simulated
    assert rig.hand.status.watchdog_trips == 0
    gaps = [later - before for before, later in itertools.pairwise(syncs)]
    assert len(gaps) > 50
    assert 0.0195 < min(gaps) <= max(gaps) < 0.0205


@pytest.mark.parametrize("start", [-0.0005, 0.0, 0.00003])
def test_homing_from_anywhere_causes_no_alarm(start: float) -> None:
    rig = VirtualRig(1, drives={"insertion_start": start}, driver={"max_depth": 0.01})
    rig.begin_homing()
    rig.until(lambda: rig.hand.status.homed, "homing")
    assert rig.hand.status.state == "DISABLED"


@pytest.mark.parametrize(("lag", "late"), [(0.0, 0.012), (0.02, 0.004)])
def test_aborted_and_continued_steps_raise_no_alarm(lag: float, late: float) -> None:
    rng = random.Random(3)
    rig = VirtualRig(1, drives={"insertion_lag": lag}, faults=(delay(CAN, late),))
    rig.home()
    rig.press()
    for _ in range(3):
        at = rig.hand.joints
        turn = rng.uniform(-0.6, 0.6)
        rig.command(at[0] + 0.001, at[1] + turn, rng.choice((0.2, 0.4, 1.0)))
        rig.runner.run(rng.uniform(0.2, 0.8))
        rig.release()
        rig.press()
    assert rig.hand.status.state in ("HOLDING", "MOVING"), rig.hand.status.fault
    assert rig.positions[0] > 0.001
