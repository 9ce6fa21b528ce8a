"""The whole graph in one thread: the rig's own nodes, the bench, the person in front of it."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from rclpy.node import Node

from needle_bringup.ros.operator import OperatorNode
from needle_console.console_parameters import ConsoleParameters
from needle_console.page.desk import Desk
from needle_console.ros.console import ConsoleNode
from needle_controller.ros.plane_controller import PlaneControllerNode
from needle_core.errors import UserError
from needle_device_driver.ros.device_driver import DeviceDriverNode
from needle_verification.ros.soak.virtual_bench import TIP_NOISE, Bench, TrackerStandIn
from needle_verification.ros.soak.virtual_can import VirtualCan, VirtualLink
from needle_verification.ros.soak.virtual_node import Place, placed, virtual_nodes
from needle_verification.ros.soak.virtual_person import (
    INSERT,
    RETRACT,
    STOP,
    Hand,
    Joystick,
    Person,
)
from needle_verification.ros.soak.virtual_recorder import VirtualRecorders
from needle_verification.ros.soak.virtual_topics import VirtualGraph
from needle_verification.soak.faults import CONSOLE, RECORDER
from needle_verification.soak.link_faults import LinkFaults
from needle_verification.soak.virtual_hold import VirtualHold
from needle_verification.soak.virtual_line import VirtualLine
from needle_verification.soak.virtual_page import VirtualPage
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualProcess, VirtualWorld

NODES = ("device_driver", "plane_controller", "operator", "stereo_tracker", "joy_node")
PERSON = "person"
SECOND_OPERATOR, SECOND_JOYSTICK = "second_operator", "second_joy_node"
_SECOND_JOY = {"joy": "second_joy"}
_DEPTHS = (0.003, 0.008)
_PRESETS = ("best", "paper")
_INSERTIONS = ("stepwise", "continuous")
# A node that ended is started again by whoever sees it [ns].
_RESTART_NS = NANOSECONDS


class VirtualRig:
    """The rig from the needle to the person.

    Parameters
    ----------
    seed : int
        Of all that is drawn.
    depth : float, optional
        How far the needle goes in [m]; drawn if none is given.

    Attributes
    ----------
    world : VirtualWorld
        Its clock and chance.
    faults : LinkFaults
        What is wrong with topics, services and bus.
    graph : VirtualGraph
        Topics and services.
    bench : Bench
        Drives and needle.
    can : VirtualCan
        The bus.
    hand, second_hand : Hand
        The person's, and that of a second one.
    processes : dict of str to VirtualProcess
        By the name of the node in it.
    nodes : dict of str to Node
        Those that run.
    recorders : VirtualRecorders or None
        Those of the run, if it is recorded.
    log : list of tuple
        Steady time [ns], node, level and text of all that was logged.
    ends : list of tuple
        Steady time [ns], node and why, of processes that ended by themselves.
    """

    def __init__(self, seed: int, depth: float | None) -> None:
        self.world = VirtualWorld(seed)
        self.faults = LinkFaults()
        self.graph = VirtualGraph(self.world, self.faults)
        self.bench = Bench(self.world)
        self.can = VirtualCan(self.world, self.bench.bus, self.faults)
        self._line = VirtualLine(self.world, self.faults)
        self.hand, self.second_hand = Hand(), Hand()
        self.processes: dict[str, VirtualProcess] = {}
        self.nodes: dict[str, Node] = {}
        self.recorders: VirtualRecorders | None = None
        self.log: list[tuple[int, str, str, str]] = []
        self.ends: list[tuple[int, str, str]] = []
        draw = self.world.chance("rig")
        self.depth = draw.uniform(*_DEPTHS) if depth is None else depth
        self.preset = draw.choice(_PRESETS)
        self.insertion = draw.choice(_INSERTIONS)
        self.start(PERSON)
        for name in NODES:
            late_ns = self.world.chance("start", name).randint(0, NANOSECONDS // 5)
            self.world.call_after(late_ns, partial(self.start, name))

    @property
    def person(self) -> Person:
        """The person."""
        person = self.nodes[PERSON]
        assert isinstance(person, Person)
        return person

    @property
    def tracker(self) -> TrackerStandIn | None:
        """Source of tips, while it runs."""
        tracker = self.nodes.get("stereo_tracker")
        return tracker if isinstance(tracker, TrackerStandIn) else None

    @property
    def page(self) -> VirtualPage | None:
        """Page of the console at which the person sits, if at one."""
        return self.person.page

    @property
    def hand_node(self) -> str:
        """Full name of the node by which the person holds."""
        return f"/{self.person.source}"

    @property
    def hand_presses(self) -> bool:
        """Whether the hand presses what could move the needle, where it holds."""
        return self.hand.holds if self.page is None else bool(self.hand.button)

    def sit_at_page(self) -> None:
        """Let the person hold by a page of the console; the joystick is not touched then."""
        self.start(CONSOLE)
        self.person.page = VirtualPage(self.world, self._line, lambda: self.hand.button)

    def record(self) -> None:
        """Record all that is published from now on."""
        self.recorders = VirtualRecorders(self.graph)
        self.start(RECORDER)

    def start(self, name: str) -> None:
        """Start a node that does not run."""
        if name in self.processes and self.processes[name].alive:
            return
        process = VirtualProcess(self.world, name, partial(self._on_end, name))
        self.processes[name] = process
        parameters, create = self._plan(name, process)
        topics = _SECOND_JOY if name in (SECOND_OPERATOR, SECOND_JOYSTICK) else {}
        own_domain = _own_domain()
        place = Place(self.graph, process, own_domain, parameters, self._tell, name, topics)
        with placed(place):
            try:
                self.nodes[name] = create()
            except UserError as error:
                process.kill()
                self._on_end(name, str(error))

    def kill(self, name: str) -> None:
        """Kill a node as SIGKILL does."""
        process = self.processes.get(name)
        if process is None or not process.alive:
            return
        process.kill()
        self.graph.remove(process, killed=True)
        # The kernel takes back what it had.
        node = self.nodes.pop(name, None)
        if node is not None:
            node.context.shutdown()

    def close(self) -> None:
        """Let go of everything that the operating system knows of."""
        for node in self.nodes.values():
            node.context.shutdown()
        if self.recorders is not None:
            self.recorders.close()

    def _plan(
        self, name: str, process: VirtualProcess
    ) -> tuple[dict[str, Any], Callable[[], Node]]:
        """Return the parameters of a node, and what makes it."""
        if name == "device_driver":

            def make_link(settings: Any, clock: Callable[[], float]) -> VirtualLink:
                return VirtualLink(settings, clock, self.can, process)

            return {"link": "virtual", "channel": "soak"}, partial(DeviceDriverNode, make_link)
        if name == "plane_controller":
            steering = {
                "preset": self.preset,
                "insertion": self.insertion,
                "depth": self.depth,
                "nominal_speed": 0.005,
                "tip_noise_bound": TIP_NOISE,
            }
            return steering, PlaneControllerNode
        if name in ("operator", SECOND_OPERATOR):
            buttons = {"key": INSERT, "retract_key": RETRACT, "stop_key": STOP}
            return {"source": "joy", **buttons}, OperatorNode
        if name == RECORDER:
            assert self.recorders is not None
            return self.recorders.plan(process)
        others: dict[str, Callable[[], Node]] = {
            "stereo_tracker": partial(TrackerStandIn, self.bench),
            "joy_node": lambda: Joystick(self.hand if self.page is None else Hand()),
            SECOND_JOYSTICK: partial(Joystick, self.second_hand),
            CONSOLE: partial(_make_console, process, self._line),
            PERSON: partial(Person, self.hand, lambda: self.bench.motors.insertion),
        }
        return {}, others[name]

    def _on_end(self, name: str, why: str) -> None:
        self.ends.append((self.world.steady_ns, name, why))
        self.graph.remove(self.processes[name], killed=False)
        node = self.nodes.pop(name, None)
        if node is not None:
            node.context.shutdown()
        self.world.call_after(_RESTART_NS, partial(self.start, name))

    def _tell(self, name: str, level: str, text: str) -> None:
        self.log.append((self.world.steady_ns, name, level, text))


@contextlib.contextmanager
def virtual_rig(seed: int, depth: float | None) -> Iterator[VirtualRig]:
    """Run the block with a rig that has its own clocks; arguments as of `VirtualRig`."""
    # Nodes made of rings of references: collected here, not somewhere in the middle of a run.
    rig = None
    with virtual_nodes():
        try:
            rig = VirtualRig(seed, depth)
            with rig.world.own_clocks():
                yield rig
        finally:
            if rig is not None:
                rig.close()
    gc.collect()


def _make_console(process: VirtualProcess, line: VirtualLine) -> ConsoleNode:
    """Make the console with its hold alone: what else a page does is the person's own here."""

    def serve(desk: Desk, settings: ConsoleParameters) -> VirtualHold:
        made.append(VirtualHold(process, line, settings.access(), desk.hold, desk.notice))
        return made[0]

    made: list[VirtualHold] = []
    node = ConsoleNode(serve)
    node.context.on_shutdown(made[0].close)
    return node


def _own_domain() -> int:
    """Return what no other process takes for its domain, a virtual one's included."""
    return 1_000_000 + os.getpid()
