"""Driver and emulated drives on a virtual clock, with a client that holds and commands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

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
from needle_core.messages import HoldSession
from needle_core.runners.transport import Fault
from needle_core.runners.virtual import VirtualRunner
from needle_core.status_messages import ControllerStatus, DeviceStatus
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters
from needle_sim.drive_emulator import POSITIONS, DriveEmulator, DriveEmulatorParameters

FASTEST = 0.005
"""Largest insertion speed [m/s]."""
DRIVER = DeviceDriver.name
_JOINTS = (m.INSERTION_JOINT, m.ROTATION_JOINT)
_PERIOD, _TIMEOUT = 0.02, 60.0


class Held(NamedTuple):
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


class VirtualRigClient(Component):
    """Publishes a hold and queued actions, and keeps received messages.

    Parameters
    ----------
    steers : bool
        Whether it sends commands; the driver rejects commands of two publishers.

    Attributes
    ----------
    held : Held
        Present state of the hand.
    joints : tuple of float
        Last joint positions [m], [rad]; rotation is 0 after homing.
    places : list of tuple of float
        Positions of the drives.
    received : Counter of str
        Number of received messages by topic.
    """

    name = "hand"

    def __init__(self, *, steers: bool) -> None:
        self.status, self.controller = DeviceStatus(), ControllerStatus()
        self.joints = (0.0, 0.0)
        self.places: list[tuple[float, float]] = []
        self.received: Counter[str] = Counter()
        self.results: dict[int, str] = {}
        self.answers: list[Answer] = []
        self.actions: list[Action] = []
        self.held = Held(False)
        self.session = HoldSession(self.name)
        self.inputs = (
            Input("device/status", DeviceStatus, self._keep("status"), LATCHED),
            Input("needle/controller_status", ControllerStatus, self._keep("controller"), LATCHED),
            Input("device/result", m.CommandResult, self._on_result),
            Input("joint_states", m.JointState, self._on_joints),
            Input(POSITIONS, m.JointState, self._on_positions),
        )
        commands = (Output("device/joint_trajectory", m.Trajectory),) if steers else ()
        self.outputs = (Output("device/hold", m.HoldState, BEST_EFFORT), *commands)
        self.timers = (Timer(_PERIOD, self._act),)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Keep the answer."""
        self.answers.append(answer)
        return ()

    def _keep(self, name: str) -> Callable[[Any, Moment], Actions]:
        def keep(message: Any, _: Moment) -> Actions:
            setattr(self, name, message)
            return ()

        return keep

    def _on_result(self, message: m.CommandResult, at: Moment) -> Actions:
        self.results[message.stamp_ns] = message.outcome
        return ()

    def _on_joints(self, message: m.JointState, at: Moment) -> Actions:
        self.received["joint_states"] += 1
        self.joints = (message.positions[0], message.positions[1])
        return ()

    def _on_positions(self, message: m.JointState, at: Moment) -> Actions:
        self.received[POSITIONS] += 1
        self.places.append((message.positions[0], message.positions[1]))
        return ()

    def _act(self, at: Moment) -> Actions:
        pressed, speed, _ = self.held
        yield Publish(
            "device/hold", self.session.next_message(at.stamp_ns, pressed=pressed, speed=speed)
        )
        yield from self.actions
        self.actions = []


class VirtualRig:
    """Drives, driver, client and other components.

    Parameters
    ----------
    seed : int
        Of the runner.
    *others : Component
        Further components; a controller among them sends the commands.
    driver, drives : mapping, optional
        Parameters of driver and drives.
    faults : sequence of Fault
        The runner's.
    """

    def __init__(
        self,
        seed: int,
        *others: Component,
        driver: Mapping[str, Any] | None = None,
        drives: Mapping[str, Any] | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        self.hand = VirtualRigClient(steers=not others)
        self.drives = DriveEmulator(DriveEmulatorParameters(**(drives or {})))
        self.bus = self.drives.bus
        parameters = DeviceDriverParameters(
            link="virtual", channel=CAN, retraction_speed=FASTEST, **(driver or {})
        )
        parts = [self.drives, DeviceDriver(parameters), *others, self.hand]
        self.runner = VirtualRunner(parts, seed, faults=faults)

    @property
    def place(self) -> tuple[float, float]:
        """True position of the motors [m], [rad]."""
        axes = self.bus.axes(self.runner.now)
        return axes["insertion"].position, axes["rotation"].position

    def home(self) -> None:
        """Home both axes, the needle being out, and enable them."""
        self.until(lambda: self.hand.status.state == "DISABLED", "the driver")
        self.call("device/confirm_needle_out", True)
        self.call("device/home")
        self.until(lambda: self.hand.status.homed, "homing")
        self.call("device/enable", True)

    def press(self) -> None:
        """Release, then press until the device reports this hold."""
        self.release()
        self.hand.held = Held(True)
        self.until(lambda: self.hand.status.hold_owner == "hand", "the hold")

    def release(self) -> None:
        """Release, and run until the device has received it."""
        self.hand.held = Held(False)
        self.runner.run(0.1)

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
        self.hand.actions.append(
            Publish("device/joint_trajectory", m.Trajectory(stamp_ns, _JOINTS, points))
        )
        return stamp_ns

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
            self.runner.run(_PERIOD)
