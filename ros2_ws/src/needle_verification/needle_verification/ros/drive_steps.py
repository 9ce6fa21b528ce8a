"""Many random steps of the device driver, as fast as driver and emulated drives answer."""

from __future__ import annotations

import math
import random
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from rosgraph_msgs.msg import Clock

from needle_bringup.simulation.rig_configuration import PATIENT_WATCHDOG
from needle_core.ros.conversions import RELIABLE, to_stamp
from needle_verification.ros.drive_hand import INSERTION_COUNT, ROTATION_COUNT, DriveHand
from needle_verification.trials.trial_processes import TrialProcesses, drives_and_driver

TICK_NS = 20_000_000
_START_NS = 1_000_000_000
_DEEPEST = 0.19
_MOST_ROTATION = 3.0
_LONGEST_STEP = 0.002
_FAST = 0.005


class _LockStep:
    """Simulated time that goes on when driver and drives have done a tick."""

    def __init__(self, hand: DriveHand) -> None:
        self._hand = hand
        self._clock = hand.create_publisher(Clock, "/clock", RELIABLE)
        self.time_ns = _START_NS
        self.ticks = 0

    def matched(self) -> bool:
        return int(self._clock.get_subscription_count()) >= 2

    def tick(self) -> None:
        hand = self._hand
        self.time_ns += TICK_NS
        self.ticks += 1
        motors = len(hand.motors)
        self._clock.publish(Clock(clock=to_stamp(self.time_ns)))
        hand.until(
            lambda: (
                len(hand.motors) > motors
                and bool(hand.joint_stamps)
                and hand.joint_stamps[-1] >= self.time_ns
            ),
            "answers to a tick",
        )

    def run_while_needed(self) -> None:
        """Let time go on until the driver needs no more."""
        quiet = 0
        while quiet < 5:
            self._hand.look(0.01)
            if self._hand.status.get("needs_time") == "true":
                self.tick()
                quiet = 0
            else:
                quiet += 1


def random_steps(folder: Path, domain: int, count: int, seed: int) -> dict[str, Any]:
    """Make random steps to the deepest, back, and again; tell where it all ended.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    count : int
        How many steps, at least 2.
    seed : int
        Of the steps.

    Returns
    -------
    dict
        Figures; distances in counts of the encoders.
    """
    rng = random.Random(seed)
    emulator = {"motion_clock": "sync", "use_sim_time": True}
    driver = {
        "use_sim_time": True,
        "lock_step": True,
        "watchdog": PATIENT_WATCHDOG,
        "reply_age_limit": PATIENT_WATCHDOG,
        "retraction_speed": _FAST,
    }
    parameters = drives_and_driver(emulator, driver)
    begin = time.monotonic()
    with (
        closing(DriveHand()) as hand,
        closing(TrialProcesses(folder, domain, parameters)) as processes,
    ):
        steps = _RandomSteps(hand, rng)
        steps.prepare()
        memory: list[int] = []
        for number in range(count):
            steps.make()
            if number in (count // 10, count - 1):
                memory.append(processes.memory())
        hand.release()
        steps.time.tick()
        processes.check()
    return {
        "steps": count,
        **steps.figures(),
        "memory_growth_MB": (memory[-1] - memory[0]) / 1e6,
        "wall_s": time.monotonic() - begin,
    }


class _RandomSteps:
    """Steps of any length, each from where the last was to end."""

    def __init__(self, hand: DriveHand, rng: random.Random) -> None:
        self._hand = hand
        self._rng = rng
        self.time = _LockStep(hand)
        hand.now_ns = lambda: self.time.time_ns
        self._at = (0.0, 0.0)
        self._failures: list[str] = []
        self._retractions = 0

    def prepare(self) -> None:
        """Home, enable, press."""
        hand = self._hand
        hand.until(
            lambda: (
                hand.ready()
                and self.time.matched()
                and hand.status.get("state") not in (None, "UNCONFIGURED")
            ),
            "the driver",
            60.0,
        )
        self.time.tick()
        hand.insist("confirm_needle_out", True)
        hand.insist("home")
        self.time.run_while_needed()
        hand.insist("enable", True)
        self.time.run_while_needed()
        hand.press()
        self._at = (hand.motors[-1].insertion, hand.motors[-1].rotation)

    def make(self) -> None:
        """Make one step, after a retraction where there is no room for it."""
        hand, rng = self._hand, self._rng
        # From a hundredth of a mm up, as often in each decade.
        length = math.exp(rng.uniform(math.log(1e-5), math.log(_LONGEST_STEP)))
        turn = rng.uniform(-0.6, 0.6)
        if abs(self._at[1] + turn) > _MOST_ROTATION:
            turn = -turn
        if self._at[0] + length > _DEEPEST:
            hand.insist("retract")
            self.time.run_while_needed()
            hand.press()
            self._retractions += 1
            self._at = (hand.motors[-1].insertion, self._at[1])
        self._at = (self._at[0] + length, self._at[1] + turn)
        # A count's rounding of where it begins must not make the fastest step too fast.
        duration = max(length / _FAST, abs(turn) / 3.0) * rng.uniform(1.01, 1.5)
        stamp = hand.command(*self._at, duration)
        while stamp not in hand.results:
            hand.look(0.002)
            if hand.status.get("needs_time") == "true":
                self.time.tick()
        if hand.results[stamp] != "succeeded":
            self._failures.append(hand.results[stamp])

    def figures(self) -> dict[str, Any]:
        """Return what came of it; distances in counts."""
        hand, off = self._hand, self._off()
        return {
            "retractions": self._retractions,
            "not_succeeded": len(self._failures),
            "not_succeeded_for": sorted(set(self._failures)),
            "results": len(hand.results),
            "final_off_insertion_counts": off[0],
            "final_off_rotation_counts": off[1],
            "ticks": self.time.ticks,
            "joint_states_of_ticks": len(set(hand.joint_stamps)),
            "drive_positions": len(hand.motors),
        }

    def _off(self) -> tuple[float, float]:
        motors = self._hand.motors[-1]
        return (
            (motors.insertion - self._at[0]) / INSERTION_COUNT,
            (motors.rotation - self._at[1]) / ROTATION_COUNT,
        )
