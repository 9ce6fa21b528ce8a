"""The rig on the virtual runner: its own components, the simulated bench and the operator model."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any

from needle_bringup.operator.component import Operator
from needle_bringup.operator.parameters import OperatorParameters
from needle_console.console import Console
from needle_console.console_parameters import ConsoleParameters
from needle_controller.plane_controller import PlaneController
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.can_frame import CAN
from needle_core.component import Component, Output
from needle_core.errors import UserError
from needle_core.messages import HoldState, LogLine
from needle_core.runners.process import uniform
from needle_core.runners.transport import Arrivals, Link
from needle_core.runners.virtual import LOG, VirtualRunner
from needle_device_driver.device import HOLD
from needle_device_driver.device_driver import DeviceDriver
from needle_device_driver.parameters import DeviceDriverParameters
from needle_sim.drive_emulator import DriveEmulator, DriveEmulatorParameters
from scenario.faults import CONSOLE, PAGE, RECORDER
from scenario.link_faults import LinkFaults
from scenario.parts.bench import ANSWER, TIP_NOISE, Bench, TrackerStandIn
from scenario.parts.hold_server import VirtualHoldServer
from scenario.parts.operator_model import (
    INSERT,
    RETRACT,
    STOP,
    Joystick,
    JoystickButtons,
    OperatorModel,
)
from scenario.parts.page import Page
from scenario.parts.recorder import Disk, RecorderStandIn

NODES = ("device_driver", "plane_controller", "operator", "stereo_tracker", "joy_node")
SECOND_OPERATOR, SECOND_JOYSTICK = "second_operator", "second_joy_node"
SECOND = (SECOND_JOYSTICK, SECOND_OPERATOR)
"""Nodes of a second operator."""
_SECOND_JOY = "second_joy"
_CONSOLE = (CONSOLE, VirtualHoldServer.name)
# Nodes whose topics are recorded.
_RECORDED = ("device_driver", "plane_controller", "operator", "joy_node")
_DEPTHS = (0.003, 0.008)
_LATEST_START = 0.2
# Initial system time of the stamps [ns]; not zero, so that it may jump back.
_CLOCK_NS = 1_750_000_000 * 10**9
# Delay until an ended node is started again [s].
_RESTART = 1.0
# Compute time of a handler, except the tracker's [s].
_COMPUTE = (0.02e-3, 0.2e-3)
_INTERNAL = "internal error"

Watcher = Callable[[str, Any], None]


class SoakRig:
    """The rig from the needle to the operator.

    Parameters
    ----------
    seed : int
        Seed of all randomness.
    depth : float, optional
        Insertion depth [m]; random if none is given.
    at_page : bool
        Whether the operator holds by a page of the console instead of the joystick.

    Attributes
    ----------
    faults : LinkFaults
        Active faults of topics, services and bus.
    runner : VirtualRunner
        Runner of all components.
    bench : Bench
        Needle and motors.
    drives : DriveEmulator
        Drives that move the needle.
    hand, second_hand : JoystickButtons
        Buttons of the operator and of a second one.
    person : OperatorModel
        The operator.
    hand_node : str
        Name of the node that publishes the operator's hold.
    page : Page or None
        Page of the operator, if any.
    disk, recorders : Disk or None, list of RecorderStandIn
        Disk and successive recorders; none unless `record` was called.
    steering : SteeringSettings
        Settings of the controller.
    watchers : dict of str to list of Watcher
        Functions by topic, called with sender and message of each publication.
    on_hold_received : callable
        Called with each hold that the driver receives, and its time [s].
    frames_sent, adapter_opened : list of callable
        Called with each batch of frames that the driver sends, and before its first.
    log : list of str
        Log lines.
    crashes : list of str
        Unexpected exceptions.
    digest : hash
        Digest of time, sender and topic of all publications.
    """

    def __init__(self, seed: int, depth: float | None = None, *, at_page: bool = False) -> None:
        self.faults = LinkFaults()
        self.watchers: dict[str, list[Watcher]] = {}
        self.on_hold_received: Callable[[HoldState, float], None] = lambda *_: None
        self.frames_sent: list[Callable[[Any], None]] = []
        self.adapter_opened: list[Callable[[], None]] = []
        self._adapter_is_open = False
        self.log: list[str] = []
        self.crashes: list[str] = []
        self.digest = hashlib.sha256()
        names = (*NODES, "person", "bench", DriveEmulator.name, PAGE, RECORDER, *_CONSOLE)
        self.runner = VirtualRunner(
            (),
            seed,
            compute={
                **dict.fromkeys((*names, *SECOND), uniform(*_COMPUTE)),
                "stereo_tracker": uniform(*ANSWER),
            },
            faults=(self._apply_faults,),
            taps=(self._tap_published,),
        )
        timeline = self.runner.timeline
        timeline.clock_offset_ns = _CLOCK_NS
        draw = timeline.stream("rig")
        self.steering = SteeringSettings(
            depth=draw.uniform(*_DEPTHS) if depth is None else depth,
            preset=draw.choice(("best", "paper")),
            insertion=draw.choice(("stepwise", "continuous")),
            nominal_speed=0.005,
            tip_noise_bound=TIP_NOISE,
        )
        self.hand, self.second_hand = JoystickButtons(), JoystickButtons()
        self.drives = DriveEmulator(DriveEmulatorParameters(boot_time=0.1))
        self.bench = Bench(self.drives.bus, timeline.stream("needle"))
        self.hand_node = CONSOLE if at_page else "operator"
        self.person = OperatorModel(self.hand, lambda: self.bench.motors.insertion, self.hand_node)
        self.page: Page | None = None
        self.disk: Disk | None = None
        self.recorders: list[RecorderStandIn] = []
        self.tracker = self._make_tracker()
        self._makers: dict[str, Callable[[], Component]] = {
            "device_driver": self._make_driver,
            "plane_controller": lambda: PlaneController(self.steering),
            "operator": lambda: Operator(_operator_settings()),
            "stereo_tracker": self._make_tracker,
            "joy_node": lambda: Joystick(JoystickButtons() if at_page else self.hand),
            CONSOLE: lambda: Console(ConsoleParameters()),
            VirtualHoldServer.name: VirtualHoldServer,
            PAGE: self._make_page,
            RECORDER: self._make_recorder,
            SECOND_OPERATOR: lambda: Operator(_operator_settings(), SECOND_OPERATOR, _SECOND_JOY),
            SECOND_JOYSTICK: lambda: Joystick(self.second_hand, SECOND_JOYSTICK, _SECOND_JOY),
        }
        for component in (self.drives, self.bench, self.person):
            self.runner.start(component)
        if at_page:
            self.start(PAGE)
        for name in (*NODES, *(_CONSOLE if at_page else ())):
            late = timeline.draw(f"start of {name}", (0.0, _LATEST_START))
            timeline.call_after(late, partial(self.start, name))

    @property
    def now(self) -> float:
        """Virtual time since the start [s]."""
        return self.runner.now

    @property
    def hand_presses(self) -> bool:
        """Whether the operator presses a button that could move the needle."""
        return self.hand.holds if self.page is None else bool(self.hand.button)

    def watch(self, topic: str, watcher: Watcher) -> None:
        """Call `watcher` with sender and message whenever one is published on a topic."""
        self.watchers.setdefault(topic, []).append(watcher)

    def start(self, name: str) -> None:
        """Start a node unless it runs."""
        if self.runner.runs(name):
            return
        try:
            self.runner.start(self._makers[name]())
        except UserError:
            # For example a recorder on a full disk.
            self.runner.timeline.call_after(_RESTART, partial(self.start, name))

    def kill(self, name: str) -> None:
        """Kill a node as SIGKILL does."""
        if self.runner.runs(name):
            self.runner.kill(name)
            if name == VirtualHoldServer.name and self.page is not None:
                self.page.cut()
            if name == RECORDER:
                self.recorders[-1].cut(self.now)

    def processes_of(self, name: str) -> tuple[str, ...]:
        """Return the components that share a process with a node; the console has two."""
        return _CONSOLE if name == CONSOLE else (name,)

    def record(self) -> None:
        """Start a recorder."""
        self.disk = Disk()
        self.start(RECORDER)

    def losses(self, *, check_killed: bool) -> list[str]:
        """End the recording; return the losses of its bags."""
        losses: list[str] = []
        for recorder in self.recorders:
            losses += recorder.losses(check_killed=check_killed)
        if self.disk is not None:
            self.disk.close()
        return losses

    def unplug(self) -> None:
        """Unplug the driver's CAN adapter."""
        self.runner.lose_port(DeviceDriver.name, CAN, "unplugged")

    def plug_in(self) -> None:
        """Plug the CAN adapter in again."""
        self._adapter_is_open = False
        self.runner.open_port(DeviceDriver.name, CAN)

    def run(self, seconds: float) -> None:
        """Run for a duration [s]; restart nodes that end."""
        end = self.now + seconds
        while self.now < end:
            if self.runner.run(end - self.now):
                for name, ended in tuple(self.runner.exits.items()):
                    del self.runner.exits[name]
                    self._on_exit(name, ended.text)

    def _on_exit(self, name: str, why: str) -> None:
        if why.startswith(_INTERNAL):
            self.crashes.append(f"{name}: {why}")
        if name in self._makers and name != PAGE:
            self.runner.timeline.call_after(_RESTART, partial(self.start, name))

    def _make_driver(self) -> Component:
        self._adapter_is_open = False
        driver = DeviceDriver(DeviceDriverParameters(link="virtual", channel="soak"))
        driver.inputs = tuple(
            dataclasses.replace(row, handler=partial(self._receive_hold, row.handler))
            if row.topic == HOLD
            else row
            for row in driver.inputs
        )
        return driver

    def _receive_hold(self, handler: Any, message: HoldState, at: Any) -> Any:
        self.on_hold_received(message, at.steady)
        return handler(message, at)

    def _make_page(self) -> Page:
        self.page = Page(lambda: self.hand.button, self.runner.timeline.stream("page"))
        self.person.shows_lost_press = self.page.asks_for_a_new_press
        return self.page

    def _make_recorder(self) -> RecorderStandIn:
        assert self.disk is not None
        parts = [make() for name, make in self._makers.items() if name in _RECORDED]
        topics = {row.topic: row for part in (*parts, self.person) for row in part.outputs}
        chance = self.runner.timeline.stream("disk")
        self.recorders.append(RecorderStandIn(self.disk, topics.values(), chance))
        return self.recorders[-1]

    def _make_tracker(self) -> TrackerStandIn:
        self.tracker = TrackerStandIn(self.bench, self.runner.timeline.stream("tips"))
        return self.tracker

    # ---- taps -----------------------------------------------------------------------------------

    def _tap_published(self, stamp_ns: int, sender: str, message: Any, output: Output) -> None:
        topic = output.topic
        self.digest.update(f"{stamp_ns} {sender} {topic}\n".encode())
        for watcher in self.watchers.get(topic, ()):
            watcher(sender, message)
        if output is LOG:
            self._on_log(message)

    def _on_log(self, line: LogLine) -> None:
        self.log.append(f"{self.now:9.3f} {line.source}: {line.severity}: {line.text}")
        if line.text.startswith(_INTERNAL):
            self.crashes.append(f"{line.source}: {line.text}")

    def _apply_faults(self, link: Link, message: Any, now: float, rng: Any) -> Arrivals | None:
        if link.topic == CAN and link.sender == "device_driver":
            for watch_opening in () if self._adapter_is_open else self.adapter_opened:
                watch_opening()
            self._adapter_is_open = True
            for take in self.frames_sent:
                take(message)
        return self.faults(link, message, now, rng)


def _operator_settings() -> OperatorParameters:
    return OperatorParameters(source="joy", key=INSERT, retract_key=RETRACT, stop_key=STOP)
