"""Every node of the rig, made once in each way that changes what it says or hears."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from code_lines import ROOT
from needle_bags.player.player_options import parse_options
from needle_bags.reading.bag_messages import read_contents
from needle_console.console import OF_BUTTON, PAGE, Console
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.hold_state import HoldState, Mode
from needle_console.page.desk import Desk
from needle_console.view.advice import Button
from needle_core.component import Call
from needle_core.convert import from_ros, ros_type
from needle_core.message_types import rclpy_types
from needle_core.process.ros_domain import own_domain
from needle_core.ros.component_node import ComponentNode
from reference.endpoints import SOURCES, Endpoint, Noted, noting

BAG = ROOT / "bags" / "regression"


@dataclasses.dataclass(frozen=True)
class Way:
    """A way to set a node.

    Attributes
    ----------
    when : str
        In words, for a reader; empty where there is only one.
    parameters : tuple of str
        As `-p` takes them; `{scratch}` is a folder.
    make : callable
        Takes the node's module, returns the node.
    then : callable
        Has the node do what it does later.
    """

    when: str = ""
    parameters: tuple[str, ...] = ()
    make: Callable[[ModuleType], Node] = lambda module: _class_of(module)()
    then: Callable[[Any, Noted], None] = lambda node, noted: None


@dataclasses.dataclass(frozen=True)
class RigNode:
    """A node, as it is.

    Attributes
    ----------
    name, package : str
        The executable's, and whose it is.
    module : ModuleType
        Where it is.
    ways : list of (str, Noted)
        In which way, and what was noted.
    """

    name: str
    package: str
    module: ModuleType
    ways: list[tuple[str, Noted]]

    def endpoints(self, *roles: str) -> list[tuple[Endpoint, str]]:
        """Return its endpoints, each once, with the ways that have it; all: an empty text."""
        found: dict[Endpoint, list[str]] = {}
        for when, noted in self.ways:
            for endpoint in noted.endpoints:
                if endpoint.role in roles:
                    found.setdefault(endpoint, []).append(when)
        every = len(self.ways)
        return [(end, "" if len(ways) == every else ", ".join(ways)) for end, ways in found.items()]

    @property
    def parameters(self) -> type:
        """Its dataclass of parameters."""
        return self.ways[0][1].parameters[0]

    @property
    def parts(self) -> dict[str, list[str]]:
        """Parts of its diagnostics, each with all keys that were seen."""
        found: dict[str, list[str]] = {}
        for _, noted in self.ways:
            for part, keys in noted.parts.items():
                known = found.setdefault(part, [])
                known += [key for key in keys if key not in known]
        return found

    @property
    def help(self) -> str:
        """Its text of `--help`, without the parameters."""
        return str(getattr(self.module, "HELP", "")).strip("\n")


def executables(kind: str) -> Iterator[tuple[str, str, str]]:
    """Yield (package, executable, module) of all executables of a kind, `node` or `command`."""
    for folder in sorted(SOURCES.iterdir()):
        if not (folder / folder.name / "executables.py").is_file():
            continue
        module = importlib.import_module(f"{folder.name}.executables")
        for name, enter in sorted(vars(module).items()):
            if getattr(enter, "__qualname__", "") == f"{kind}.<locals>.enter":
                yield folder.name, name, inspect.getclosurevars(enter).nonlocals["module"]


def rig_nodes() -> list[RigNode]:
    """Make every node of the rig in all its ways, and return what was noted."""
    found = []
    with own_domain() as domain, tempfile.TemporaryDirectory() as scratch:
        for package, name, module_name in executables("node"):
            module = importlib.import_module(module_name)
            ways = [
                (way.when, _noted(module, way, domain, Path(scratch, f"{name}_{number}")))
                for number, way in enumerate(WAYS.get(name, (Way(),)))
            ]
            found.append(RigNode(name, package, module, ways))
    return found


def _noted(module: ModuleType, way: Way, domain: int, scratch: Path) -> Noted:
    arguments = ["--ros-args", "--log-level", "fatal"]
    for parameter in way.parameters:
        arguments += ["-p", parameter.format(scratch=scratch)]
    options = SignalHandlerOptions.NO
    rclpy.init(args=arguments, domain_id=domain, signal_handler_options=options)
    try:
        with noting() as noted:
            node = way.make(module)
            try:
                way.then(node, noted)
            finally:
                getattr(node, "close", lambda: None)()
                node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return noted


def _class_of(module: ModuleType) -> Callable[[], Node]:
    """Return what makes a module's node: its class, or what its `main` runs a component by."""
    found = [
        each
        for each in vars(module).values()
        if inspect.isclass(each) and issubclass(each, Node) and each.__module__ == module.__name__
    ]
    if found:
        return found[0]
    run_node, find_spec = "needle_core.ros.main.run_node", "importlib.util.find_spec"
    # What it says and hears is the same without its extra.
    with mock.patch(run_node, return_value=0) as run, mock.patch(find_spec):
        module.main()
    make: Callable[[], Node] = run.call_args.args[0]
    return make


def _turn(node: Any, _: Noted) -> None:
    """Let everything happen that happens by itself."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    for _turns in range(5):
        executor.spin_once(timeout_sec=0.0)
    executor.shutdown()


def _live_view(module: ModuleType) -> Node:
    """Make it as where there is tf2_msgs, for whose message another one stands in."""
    kind = type(String)("TFMessage", (String,), {"__module__": "tf2_msgs.msg"})
    # Not by mock.patch.dict, which would forget all that is imported meanwhile.
    sys.modules["tf2_msgs.msg"] = mock.Mock(TFMessage=kind)
    try:
        return _class_of(module)()
    finally:
        del sys.modules["tf2_msgs.msg"]


def _hear(node: Any, noted: Noted) -> None:
    """Hear an empty message of everything, images included."""
    for row in node.component.inputs:
        if row.lazy:
            node._listen(row.topic, True)
        message = from_ros(row.message, rclpy_types().make(ros_type(row.message))())
        node._handle(lambda row=row, message=message: row.handler(message, node._moment()))
    _tick(node, noted)


def _console(_: ModuleType) -> Node:
    """Make the console without its page: that wants NiceGUI and ports."""

    def make(settings: ConsoleParameters, _: str) -> Console:
        return Console(settings)

    return ComponentNode(
        Console.name, ConsoleParameters, make, lambda settings: {PAGE: Desk(settings)}
    )


def _look_at_page(node: Any, noted: Noted) -> None:
    desk = node._ports[PAGE]
    desk.picture("left")
    for button in Button:
        if button in OF_BUTTON:
            desk.press(button)
    desk.hold(HoldState(True, 1.0, Mode.RETRACT))
    node._take_arrived()
    for timer in node.component.timers:
        node._handle(lambda timer=timer: timer.handler(node._moment()))
    for service in ("device/retract", "plane_controller/stop"):
        node._do(Call(service))


def _player(module: ModuleType, *more: str) -> Node:
    options = parse_options([str(BAG), *more])
    node: Node = module.Player(options, read_contents(BAG))
    return node


def _make_and_look(node: Any, _: Noted) -> None:
    node._make_publishers()
    node.check_graph()


def _report_and_close(node: Any, _: Noted) -> None:
    node.report()
    node.recording.close()


def _tick(node: Any, noted: Noted) -> None:
    """Do what every timer does."""
    for timer in list(node.timers):
        timer.callback()
    _turn(node, noted)


def _camera(module: ModuleType) -> Node:
    """Make what publishes images, without any."""
    with mock.patch("needle_tracker.stereo_camera.open_source"):
        return _class_of(module)()


WAYS: dict[str, tuple[Way, ...]] = {
    "console": (Way(make=_console, then=_look_at_page),),
    "device_driver": (Way(then=_tick),),
    "live_view": (Way(make=_live_view, then=_hear),),
    "openigtlink": (Way("", ("port:=0",), then=_hear),),
    "operator": (
        Way("sources pedal and joystick", ("device:=/dev/null", "key:=48"), then=_tick),
        Way("source joy", ("source:=joy", "key:=0"), then=_tick),
    ),
    "player": (
        Way(make=_player, then=_make_and_look),
        Way(
            "with `--clock`",
            make=lambda module: _player(module, "--clock", "100"),
            then=_make_and_look,
        ),
    ),
    "recorder": (
        Way("", ("bag:={scratch}",), then=_report_and_close),
        Way(
            "with `snapshot_seconds`",
            ("bag:={scratch}", "snapshot_seconds:=1.0"),
            then=_report_and_close,
        ),
    ),
    "sim_rig": (
        Way("level tip", ("level:=tip",), then=_tick),
        Way("level camera", ("level:=camera",), then=_tick),
        Way("level drive", ("level:=drive",), then=_tick),
    ),
    "simulated_operator": (
        Way(then=_tick),
        Way("with `wait_for_recorder`", ("wait_for_recorder:=true",)),
    ),
    "stereo_camera": (Way(make=_camera, then=_tick),),
    "stereo_tracker": (Way(then=_turn),),
}
"""How to make a node that wants more than its name, or has several ways."""
