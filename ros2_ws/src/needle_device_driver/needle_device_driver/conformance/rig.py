"""device_driver, emulated drives and an operator on a virtual clock."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple

from needle_core import messages as m
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
from needle_core.messages import HoldSession
from needle_core.runners.transport import Arrival, Arrivals, Fault, Link
from needle_core.runners.virtual import LOG, VirtualRunner
from needle_core.status_messages import DeviceStatus
from needle_device_driver.axes.axis import PERIOD, Axis
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.device import COMMANDS, EMERGENCY_STOP, HOLD, JOINTS, RESULT, STATUS
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters
from needle_device_driver.rules import Rule

FASTEST = 0.005
"""Largest insertion speed [m/s]."""
DRIVER = DeviceDriver.name
AXES = ("insertion", "rotation")
AT_REST = (1e-6, 1e-4)
"""Largest motion of motors at rest [m], [rad]: encoder counts."""
# Counts per m and rad that every kind of drive supports at the largest speed.
_COUNTS = {"insertion_counts_per_unit": 2.0e6, "rotation_counts_per_unit": 3000.0}
_JOINT_NAMES = (m.INSERTION_JOINT, m.ROTATION_JOINT)
_TIMEOUT = 60.0


class HandState(NamedTuple):
    """State of the operator's hand.

    Attributes
    ----------
    pressed : bool
        Whether the hold is pressed.
    speed : float
        Speed scale 0..1.
    push : float
        Speed of a manual insertion without a motor [m/s].
    """

    pressed: bool
    speed: float = 1.0
    push: float = 0.0


class RigClient(Component):
    """Publishes a hold and queued actions, and keeps received messages.

    Parameters
    ----------
    steers : bool
        Whether it sends commands; the driver rejects commands from two publishers.

    Attributes
    ----------
    state : HandState
        Present state of the hand.
    joints : tuple of float
        Last joint positions [m], [rad]; rotation is 0 after homing.
    results : dict of int to str
        Outcome of each command by its stamp.
    """

    name = "hand"

    def __init__(self, *, steers: bool = True) -> None:
        self.status = DeviceStatus()
        self.joints = (0.0, 0.0)
        self.results: dict[int, str] = {}
        self.answers: list[Answer] = []
        self.actions: list[Action] = []
        self.state = HandState(False)
        self.session = HoldSession(self.name)
        self.inputs: Sequence[Input] = (
            Input(STATUS, DeviceStatus, self._on_status, LATCHED),
            Input(RESULT, m.CommandResult, self._on_result),
            Input(JOINTS, m.JointState, self._on_joints),
        )
        commands = (Output(COMMANDS, m.Trajectory),) if steers else ()
        hold = Output(HOLD, m.HoldState, BEST_EFFORT)
        self.outputs = (hold, Output(EMERGENCY_STOP, m.EmergencyStop), *commands)
        self.timers = (Timer(PERIOD, self._act),)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Keep the answer."""
        self.answers.append(answer)
        return ()

    def _on_status(self, message: DeviceStatus, at: Moment) -> Actions:
        self.status = message
        return ()

    def _on_result(self, message: m.CommandResult, at: Moment) -> Actions:
        self.results[message.stamp_ns] = message.outcome
        return ()

    def _on_joints(self, message: m.JointState, at: Moment) -> Actions:
        self.joints = (message.positions[0], message.positions[1])
        return ()

    def _act(self, at: Moment) -> Actions:
        pressed, speed, _ = self.state
        yield Publish(HOLD, self.session.next_message(at.stamp_ns, pressed=pressed, speed=speed))
        yield from self.actions
        self.actions = []


class ConformanceRig:
    """Emulated drives, driver, client and other components.

    Parameters
    ----------
    seed : int
        Seed of the runner.
    *others : Component
        Further components.
    axis : str
        Kind of drive of both axes, with counts that every kind supports; by default cia402.
    hand : RigClient, optional
        The client.
    driver, drives : mapping, optional
        Parameters of driver and emulated drives.
    faults : sequence of Fault
        Faults of the runner.

    Attributes
    ----------
    logged : list of str
        Lines of the log.
    commands : list of int
        Stamps of the commands.
    late : float
        Additional delay of the drives' replies [s].
    """

    def __init__(
        self,
        seed: int,
        *others: Component,
        axis: str = "",
        hand: RigClient | None = None,
        driver: Mapping[str, Any] | None = None,
        drives: Mapping[str, Any] | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        # Imported by name: the emulators share no code with the driver.
        emulator = import_module("needle_sim.drive_emulator")
        self.hand = hand or RigClient()
        self.logged: list[str] = []
        counts = _COUNTS if axis else {}
        kinds = {"insertion_drive": axis, "rotation_drive": axis} if axis else {}
        emulated = counts | {"drives": axis or "cia402"} | dict(drives or {})
        self.drives = emulator.DriveEmulator(emulator.DriveEmulatorParameters(**emulated))
        virtual = {"link": "virtual", "channel": "can", "retraction_speed": FASTEST}
        self.settings = DeviceDriverParameters(**virtual | counts | kinds | dict(driver or {}))
        self.driver = DeviceDriver(self.settings)
        parts = [self.drives, self.driver, *others, self.hand]
        self.late, self.commands = 0.0, list[int]()
        self.runner = VirtualRunner(
            parts, seed, faults=(self._delay, *faults), taps=(self._keep_log,)
        )

    def _keep_log(self, _: int, sender: str, message: Any, output: Output) -> None:
        if output.topic == LOG.topic:
            self.logged.append(message.text)

    def _delay(self, link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        is_reply = link.receiver == DRIVER and link.topic in self.drives.connections
        return (Arrival(self.late * is_reply, message),)

    # ---- the operator -------------------------------------------------------------------------

    def start(self) -> None:
        """Run until the driver has found its drives."""
        self.until(lambda: self.state == "DISABLED", "the driver")

    def begin_homing(self) -> None:
        """Begin homing both axes with the needle out."""
        self.start()
        self.call("device/confirm_needle_out", True)
        self.call("device/home")

    def home(self) -> None:
        """Home both axes, and enable them."""
        self.begin_homing()
        self.until(lambda: self.hand.status.homed, "homing")
        self.call("device/enable", True)

    def hold(self, pressed: bool) -> None:
        """Press or release the hold."""
        self.hand.state = HandState(pressed)

    def press(self) -> None:
        """Release, then press until the device reports this hold."""
        self.release()
        self.hold(True)
        self.until(lambda: self.hand.status.hold_owner == "hand", "the hold")

    def release(self) -> None:
        """Release, and run until the device has received it."""
        self.hold(False)
        self.runner.run(0.1)

    def ready(self) -> None:
        """Home, enable, press."""
        self.home()
        self.press()

    def call(self, name: str, request: bool | None = None) -> None:
        """Call a service until it succeeds; it fails while the axes switch off."""

        def succeeds() -> bool:
            self.hand.answers.clear()
            self.hand.actions.append(Call(name, request))
            self.until(lambda: bool(self.hand.answers), f"an answer of {name}")
            return self.hand.answers[0].success

        self.until(succeeds, name)

    def command(self, insertion: float, rotation: float, duration: float) -> int:
        """Send a step to a position [m], [rad] with a duration [s]; return its stamp."""
        stamp_ns = self.runner.timeline.stamp_ns
        points = (m.TrajectoryPoint((insertion, rotation), duration),)
        self.hand.actions.append(Publish(COMMANDS, m.Trajectory(stamp_ns, _JOINT_NAMES, points)))
        self.commands.append(stamp_ns)
        return stamp_ns

    def step(self, length: float = 0.002, turn: float = 1.0, duration: float = 1.0) -> int:
        """Send a step from the present position [m], [rad], [s]; return its stamp."""
        at = self.hand.joints
        stamp = self.command(at[0] + length, at[1] + turn, duration)
        self.runner.run(0.1)
        return stamp

    def moving(self, duration: float = 1.0) -> int:
        """Get ready, and run until a step of 2 mm is under way; return its stamp."""
        self.ready()
        begin = self.positions[0]
        stamp = self.step(duration=duration)
        self.until(lambda: self.positions[0] > begin + 0.0005, "a step under way")
        return stamp

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Run until a condition holds.

        Raises
        ------
        UserError
            If it does not hold within a minute of virtual time.
        """
        end = self.runner.now + _TIMEOUT
        while not condition():
            if self.runner.now > end:
                status = self.hand.status
                raise UserError(f"timed out after {_TIMEOUT:g} s: {what}: {status}")
            self.runner.run(PERIOD)

    # ---- observations -------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """State of the device."""
        return self.hand.status.state

    @property
    def positions(self) -> tuple[float, float]:
        """True position of the motors [m], [rad]."""
        axes = self.drives.axes(self.runner.now)
        return axes["insertion"].position, axes["rotation"].position

    def emulator(self, axis: str) -> Any:
        """Return the emulated drives of an axis, which can be made to fail."""
        return next(one for one in self.drives.connections.values() if axis in one.motors)

    @property
    def capabilities(self) -> Capabilities:
        """Abilities of the drives."""
        return self.driver.drives[0].capabilities

    def axis(self, name: str) -> Axis:
        """Return an axis of the driver."""
        return next(drives.axes[name] for drives in self.driver.drives if name in drives.axes)

    @property
    def insertion_protocol(self) -> Any:
        """Protocol of the insertion drive; None for CiA 402."""
        drives = next(one for one in self.driver.drives if "insertion" in one.axes)
        return getattr(drives, "protocol", None)

    def distance(self, begin: tuple[float, float]) -> tuple[float, float]:
        """Return the distance of the motors from a position [m], [rad]; 0: at rest."""
        distances = (abs(now - before) for now, before in zip(self.positions, begin, strict=True))
        settings = self.settings
        counts = settings.insertion_counts_per_unit, settings.rotation_counts_per_unit
        # Switching on moves a motor to the nearest count.
        insertion, rotation = (
            0.0 if distance <= max(most, 1.0 / scale) else distance
            for distance, most, scale in zip(distances, AT_REST, counts, strict=True)
        )
        return insertion, rotation

    def is_logged(self, rule: Rule) -> bool:
        """Return whether the log names a rule."""
        return any(f"[{rule.value}]" in line for line in self.logged)

    def is_at_rest(self, seconds: float = 0.3) -> bool:
        """Return whether no motor moves for a time [s]."""
        travel = self.travel(lambda: None, seconds)
        return all(distance <= most for distance, most in zip(travel, AT_REST, strict=True))

    def fails(self, rule: Rule) -> bool:
        """Return whether the device is in FAULT because of a rule, and nothing moves."""
        self.runner.run(0.3)
        return self.is_at_rest() and self.is_logged(rule) and self.state == "FAULT"

    def travel(self, event: Callable[[], object], seconds: float) -> tuple[float, float]:
        """Return the largest distance that the motors move after an event [m], [rad]."""
        begin, end = self.positions, self.runner.now + seconds
        farthest = (0.0, 0.0)
        event()
        while self.runner.now < end:
            self.runner.run(PERIOD)
            here = self.positions
            farthest = (
                max(farthest[0], abs(here[0] - begin[0])),
                max(farthest[1], abs(here[1] - begin[1])),
            )
        return farthest
