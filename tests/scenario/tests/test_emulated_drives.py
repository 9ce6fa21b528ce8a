"""Driver and emulated drives: homing, set-up and cycles without faults."""

from __future__ import annotations

import itertools
import math
import random
from typing import Any

import pytest

from needle_core.can_frame import CAN, CanFrame
from needle_core.component import Publish
from needle_core.messages import EmergencyStop
from needle_core.runners.transport import Arrival, Arrivals, Link
from needle_device_driver.conformance.rig import DRIVER
from scenario.transport_faults import delay
from scenario.virtual_rig import ESTOP, VirtualRig

SYNC, DEVICE_TYPE, LIMITS, HOMING_SPEEDS = 0x080, 0x1000, 0x607D, 0x6099


class Bus:
    """Records every frame; loses those of one identifier for 0.3 s before `until`."""

    def __init__(self, loses: int = 0) -> None:
        self.frames: list[tuple[float, str, CanFrame]] = []
        self.loses, self.until = loses, -math.inf

    def __call__(self, link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        if link.topic == CAN:
            if self.until - 0.3 <= now < self.until:
                message = tuple(frame for frame in message if frame.identifier != self.loses)
            self.frames += [(now, link.sender, frame) for frame in message]
        return (Arrival(0.0, message),)

    def orders(self, *cob_ids: int, since: float = 0.0) -> list[tuple[float, CanFrame]]:
        """Return the frames that the driver sent under these COB-IDs."""
        return [
            (time, frame)
            for time, sender, frame in self.frames
            if sender == DRIVER and frame.identifier in cob_ids and time >= since
        ]


def index_of(frame: CanFrame) -> int:
    """Return the object index of an SDO frame."""
    return int.from_bytes(frame.data[1:3], "little")


def test_a_step_moves_in_equal_cycles_to_its_target() -> None:
    bus = Bus()
    rig = VirtualRig(1, faults=(bus,))
    rig.home()
    rig.press()
    begin = rig.runner.now
    stamp = rig.command(0.002, 0.5, 1.0)
    rig.until(lambda: stamp in rig.hand.results, "the result")
    assert rig.hand.results[stamp] == "succeeded"
    assert rig.positions == pytest.approx((0.002, 0.5), abs=1e-3)
    assert rig.hand.status.simulated
    assert rig.hand.status.watchdog_trips == 0
    times = [time for time, _ in bus.orders(SYNC, since=begin)]
    gaps = [later - before for before, later in itertools.pairwise(times)]
    assert len(times) > 50
    assert 0.0195 < min(gaps) <= max(gaps) < 0.0205


def home(rig: VirtualRig) -> float:
    """Home the rig; return the duration from the answer on [s]."""
    rig.begin_homing()
    begin = rig.runner.now
    rig.until(lambda: rig.hand.status.homed, "homing")
    return rig.runner.now - begin


def test_drives_that_report_speeds_in_rpm_home_at_the_requested_speed() -> None:
    rig = VirtualRig(1, drives={"rpm": True, "insertion_start": 0.002})
    # 2 mm at 2 mm/s, and the distance off the switch.
    assert 1.0 < home(rig) < 1.6
    assert rig.positions[0] == pytest.approx(0.0, abs=2e-5)


@pytest.mark.parametrize("start", [-0.0005, 0.0, 0.00003])
def test_homing_from_anywhere_causes_no_alarm(start: float) -> None:
    rig = VirtualRig(1, drives={"insertion_start": start}, driver={"max_depth": 0.01})
    home(rig)
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


def test_drives_are_set_up_in_parallel_and_homing_starts_when_both_have_limits() -> None:
    bus = Bus(loses=0x582)
    rig = VirtualRig(1, faults=(bus,))
    rig.until(lambda: rig.hand.status.state == "DISABLED", "the driver")
    asked = {
        cob: [time for time, frame in bus.orders(cob) if index_of(frame) != DEVICE_TYPE]
        for cob in (0x601, 0x602)
    }
    assert asked[0x601][0] < asked[0x602][-1]
    assert asked[0x602][0] < asked[0x601][-1]
    rig.call("device/confirm_needle_out", True)
    # The rotation drive's answers are lost for a while, so the request is repeated.
    begin, bus.until = rig.runner.now, rig.runner.now + 0.3
    rig.call("device/home")
    replied = rig.runner.now
    rig.until(lambda: rig.hand.status.homed, "homing")
    first = min(t for t, frame in bus.orders(0x201, 0x202, since=begin) if frame.data[0] & 0x10)
    taken = {
        (frame.identifier, index_of(frame), frame.data[3]): time
        for time, _, frame in bus.frames
        if time >= begin and frame.identifier in (0x581, 0x582) and frame.data[0] == 0x60
    }
    required = itertools.product((0x581, 0x582), (LIMITS, HOMING_SPEEDS), (1, 2))
    assert max(taken[key] for key in required) < min(first, replied)
    assert replied > bus.until


def test_an_emergency_stop_cancels_a_set_up_until_it_is_released() -> None:
    scene = VirtualRig(1)
    other = scene.start_node(ESTOP)
    scene.act(other, Publish(ESTOP.topic, EmergencyStop(True)))
    scene.until(lambda: scene.state == "ESTOPPED", "the emergency stop")
    assert scene.is_at_rest(1.5)
    assert scene.state == "ESTOPPED"
    scene.act(other, Publish(ESTOP.topic, EmergencyStop(False)))
    scene.until(lambda: scene.state == "DISABLED", "the set-up")
