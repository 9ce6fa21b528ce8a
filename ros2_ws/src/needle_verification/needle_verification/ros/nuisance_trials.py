"""Nuisances from others while a step is under way, and how long they hold the driver's cycle up."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Bool

from needle_core.ros.conversions import RELIABLE, values_of
from needle_device_driver.parameters import LONGEST_WATCHDOG
from needle_verification.ros.drive_hand import DriveHand
from needle_verification.trials.trial_processes import TrialProcesses, drives_and_driver
from needle_verification.trials.trial_runner import Outcomes, Trial

_STEP = 0.0019
_SPEED = 0.0003
_BEFORE = 0.5


def nuisance_trials(
    folder: Path, domain: int, trials: Iterable[Trial], duration: float
) -> Outcomes:
    """Yield what came of each kind of nuisance.

    Parameters
    ----------
    folder : Path
        Takes the logs.
    domain : int
        ROS_DOMAIN_ID.
    trials : iterable of Trial
        Their kinds are of `NUISANCE_KINDS`.
    duration : float
        How long each goes on [s], within one step.
    """
    # A machine under load is no reason to stop: how long a cycle takes is what is looked at.
    patient = {"watchdog": LONGEST_WATCHDOG, "reply_age_limit": LONGEST_WATCHDOG}
    parameters = drives_and_driver({}, patient)
    with closing(DriveHand()) as hand, closing(TrialProcesses(folder, domain, parameters)) as nodes:
        step = _DisturbedStep(hand, nodes, domain)
        for trial in trials:
            yield trial.outcome(step.run(trial.kind, duration))
            nodes.check()


class _DisturbedStep:
    """A hand that steps, and what the driver says of its cycles meanwhile."""

    def __init__(self, hand: DriveHand, processes: TrialProcesses, domain: int) -> None:
        self._hand = hand
        self._environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
        self._longest: list[float] = []
        self._memory = processes.memory
        self._estops = hand.create_publisher(Bool, "device/estop", RELIABLE)
        hand.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RELIABLE)
        hand.until(hand.ready, "the driver", 60.0)
        hand.until(lambda: self._estops.get_subscription_count() > 0, "the emergency stop's ear")
        hand.home()

    def run(self, kind: str, duration: float) -> dict[str, Any]:
        """Begin a step, be a nuisance, press the emergency stop in the middle of it."""
        hand = self._hand
        hand.insist("enable", True)
        hand.press()
        hand.until(lambda: hand.status.get("needs_time") == "false", "power")
        assert hand.joints is not None
        at = hand.joints.position
        stamp = hand.command(at[0] + _STEP, at[1], _STEP / _SPEED)
        hand.until(lambda: hand.status.get("state") == "MOVING", "a step")
        hand.pause(_BEFORE)
        memory = self._memory()
        with subprocess.Popen(
            [sys.executable, "-m", "needle_verification.ros.nuisance", kind],
            env=self._environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as nuisance:
            assert nuisance.stdin is not None and nuisance.stdout is not None
            os.set_blocking(nuisance.stdout.fileno(), False)
            hand.until(lambda: bool(nuisance.stdout and nuisance.stdout.read()), "the nuisance")
            self._longest.clear()
            hand.pause(duration)
            ended_by = hand.results.get(stamp, "")
            pressed_at = time.monotonic()
            self._estops.publish(Bool(data=True))
            hand.until(lambda: hand.status.get("state") == "ESTOPPED", "the emergency stop")
            heard = time.monotonic() - pressed_at
            nuisance.stdin.close()
        hand.until(lambda: len(self._longest) > duration, "the last cycles")
        grown = self._memory() - memory
        self._estops.publish(Bool(data=False))
        hand.release()
        hand.insist("reset")
        return {
            "longest_cycle_s": max(self._longest),
            "estop_heard_s": heard,
            "step_ended_by": ended_by,
            "memory_growth_MB": grown / 1e6,
        }

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("device_driver: can"):
                self._longest.append(float(values_of(status)["longest_cycle_s"]))
