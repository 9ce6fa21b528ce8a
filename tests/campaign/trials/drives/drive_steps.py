"""Many random steps of the device driver on the emulated drives, on a virtual clock."""

from __future__ import annotations

import math
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from needle_core import messages as m
from needle_core.can_frame import CAN
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Action,
    Actions,
    Answer,
    Call,
    Component,
    Input,
    Moment,
    Output,
    Publish,
    Timer,
)
from needle_core.errors import UserError
from needle_core.hold_session import HoldSession
from needle_core.runners.virtual import VirtualRunner
from needle_core.status_messages import DeviceStatus
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters
from needle_sim.drive_emulator import POSITIONS, DriveEmulator
from needle_sim.drive_emulator_parameters import COUNTS_PER_RADIAN, DriveEmulatorParameters

_DEEPEST = 0.19
_MOST_ROTATION = 3.0
_LONGEST_STEP = 0.002
_FAST = 0.005
_PATIENCE = 60.0
_JOINTS = (m.INSERTION_JOINT, m.ROTATION_JOINT)


def random_steps(count: int, seed: int) -> dict[str, Any]:
    """Make random steps to the deepest, back, and again; tell where it all ended.

    Parameters
    ----------
    count : int
        How many steps, at least 2.
    seed : int
        Of the steps.

    Returns
    -------
    dict
        Figures; distances in counts of the encoders.
    """
    begin = time.monotonic()
    steps = _RandomSteps(seed)
    steps.prepare()
    memory: list[int] = []
    for number in range(count):
        steps.make()
        if number in (count // 10, count - 1):
            memory.append(_memory())
    return {
        "steps": count,
        **steps.figures(),
        "memory_growth_MB": (memory[-1] - memory[0]) / 1e6,
        "wall_s": time.monotonic() - begin,
    }


class _Person(Component):
    """Holds, sends what it is told to, and keeps what it hears last."""

    name = "person"

    def __init__(self) -> None:
        self.status = DeviceStatus()
        self.motors = (0.0, 0.0)
        self.joints = self.positions = 0
        self.results: dict[int, str] = {}
        self.answers: list[Answer] = []
        self.pressed = False
        self._session = HoldSession(self.name)
        self.actions: list[Action] = []
        self.inputs = (
            Input("device/status", DeviceStatus, self._on_status, LATCHED),
            Input("device/result", m.CommandResult, self._on_result),
            Input("joint_states", m.JointState, self._on_joints),
            Input(POSITIONS, m.JointState, self._on_positions),
        )
        self.outputs = (
            Output("device/hold", m.HoldState, BEST_EFFORT),
            Output("device/joint_trajectory", m.Trajectory),
        )
        self.timers = (Timer(0.02, self._act),)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers.append(answer)
        return ()

    def _on_status(self, message: DeviceStatus, at: Moment) -> Actions:
        self.status = message
        return ()

    def _on_result(self, message: m.CommandResult, at: Moment) -> Actions:
        self.results[message.stamp_ns] = message.outcome
        return ()

    def _on_joints(self, message: m.JointState, at: Moment) -> Actions:
        self.joints += 1
        return ()

    def _on_positions(self, message: m.JointState, at: Moment) -> Actions:
        self.positions += 1
        self.motors = (message.positions[0], message.positions[1])
        return ()

    def _act(self, at: Moment) -> Actions:
        yield Publish("device/hold", self._session.say(at.stamp_ns, pressed=self.pressed))
        yield from self.actions
        self.actions = []


class _RandomSteps:
    """Steps of any length, each from where the last was to end."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)
        self._person = _Person()
        driver = DeviceDriverParameters(link="virtual", channel=CAN, retraction_speed=_FAST)
        drives = DriveEmulator(DriveEmulatorParameters())
        self._runner = VirtualRunner([drives, DeviceDriver(driver), self._person], seed)
        self._at = (0.0, 0.0)
        self._failures: list[str] = []
        self._retractions = 0
        self._begun = 0.0

    def prepare(self) -> None:
        """Home, enable, press."""
        self._until(lambda: self._person.status.state == "DISABLED", "the driver")
        self._call("confirm_needle_out", True)
        self._call("home")
        self._until(lambda: self._person.status.homed, "homing")
        self._call("enable", True)
        self._press()
        self._at = self._person.motors
        self._begun = self._runner.timeline.now
        self._person.joints = self._person.positions = 0

    def make(self) -> None:
        """Make one step, after a retraction where there is no room for it."""
        rng, person = self._rng, self._person
        # From a hundredth of a mm up, as often in each decade.
        length = math.exp(rng.uniform(math.log(1e-5), math.log(_LONGEST_STEP)))
        turn = rng.uniform(-0.6, 0.6)
        if abs(self._at[1] + turn) > _MOST_ROTATION:
            turn = -turn
        if self._at[0] + length > _DEEPEST:
            self._call("retract")
            self._until(lambda: person.motors[0] == 0.0, "the retraction")
            self._press()
            self._retractions += 1
            self._at = (person.motors[0], self._at[1])
        self._at = (self._at[0] + length, self._at[1] + turn)
        # A count's rounding of where it begins must not make the fastest step too fast.
        duration = max(length / _FAST, abs(turn) / 3.0) * rng.uniform(1.01, 1.5)
        stamp_ns = self._runner.timeline.stamp_ns
        command = m.Trajectory(stamp_ns, _JOINTS, (m.TrajectoryPoint(self._at, duration),))
        person.actions.append(Publish("device/joint_trajectory", command))
        self._until(lambda: stamp_ns in person.results, "the result of a step")
        if person.results[stamp_ns] != "succeeded":
            self._failures.append(person.results[stamp_ns])

    def figures(self) -> dict[str, Any]:
        """Return what came of it; distances in counts."""
        person = self._person
        self._runner.run(0.1)
        scales = (DriveEmulatorParameters().insertion_counts_per_unit, COUNTS_PER_RADIAN)
        off = [
            (true - wanted) * scale
            for true, wanted, scale in zip(person.motors, self._at, scales, strict=True)
        ]
        return {
            "retractions": self._retractions,
            "not_succeeded": len(self._failures),
            "not_succeeded_for": sorted(set(self._failures)),
            "results": len(person.results),
            "final_off_insertion_counts": off[0],
            "final_off_rotation_counts": off[1],
            "cycles": math.floor((self._runner.timeline.now - self._begun) / 0.02),
            "joint_states": person.joints,
            "drive_positions": person.positions,
        }

    def _press(self) -> None:
        """Let go, as every hold begins, and press."""
        self._person.pressed = False
        self._runner.run(0.1)
        self._person.pressed = True
        self._until(lambda: self._person.status.hold_owner == "person", "the hold")

    def _call(self, name: str, request: bool | None = None) -> None:
        """Call a service until it agrees: it refuses while the axes switch off."""

        def agrees() -> bool:
            self._person.answers.clear()
            self._person.actions.append(Call(f"device/{name}", request))
            self._until(lambda: bool(self._person.answers), f"an answer of {name}")
            return self._person.answers[0].success

        self._until(agrees, name)

    def _until(self, condition: Callable[[], bool], what: str) -> None:
        end = self._runner.timeline.now + _PATIENCE
        while not condition():
            if self._runner.timeline.now > end:
                raise UserError(f"waited {_PATIENCE:g} s in vain for {what}: {self._person.status}")
            self._runner.run(0.02)


def _memory() -> int:
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
