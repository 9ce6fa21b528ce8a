"""Constructs every node of the rig in each variant that has other topics or services."""

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
from needle_console.console import CALLS, PAGE, Console
from needle_console.console_parameters import ConsoleParameters
from needle_console.hold.page_session import Mode, PageHold
from needle_console.page.page_port import PagePort
from needle_console.view.advice import Button
from needle_core.component import Call
from needle_core.convert import from_ros, ros_type
from needle_core.message_types import rclpy_types
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.ros.component_node import ComponentNode
from reference.endpoints import SOURCES, Endpoint, NodeRecord, record_nodes

BAG = ROOT / "bags" / "regression"
REGISTRATION = ROOT / "ros2_ws/src/needle_tracker/test/data/registration.yaml"


@dataclasses.dataclass(frozen=True)
class NodeVariant:
    """A configuration of a node.

    Attributes
    ----------
    when : str
        Description for the reader; empty for the only variant.
    parameters : tuple of str
        Arguments of `-p`; `{scratch}` is a folder.
    make : callable
        Constructs the node from its module.
    then : callable
        Runs the node's callbacks.
    """

    when: str = ""
    parameters: tuple[str, ...] = ()
    make: Callable[[ModuleType], Node] = lambda module: _class_of(module)()
    then: Callable[[Any, NodeRecord], None] = lambda node, record: None


@dataclasses.dataclass(frozen=True)
class RigNode:
    """A node of the rig and its records.

    Attributes
    ----------
    name, package : str
        Executable and package.
    module : ModuleType
        Module of the node.
    variants : list of (str, NodeRecord)
        Description of each variant, and its record.
    """

    name: str
    package: str
    module: ModuleType
    variants: list[tuple[str, NodeRecord]]

    def endpoints(self, *roles: str) -> list[tuple[Endpoint, str]]:
        """Return each endpoint with the variants that have it; an empty text for all."""
        found: dict[Endpoint, list[str]] = {}
        for when, record in self.variants:
            for endpoint in record.endpoints:
                if endpoint.role in roles:
                    found.setdefault(endpoint, []).append(when)
        every = len(self.variants)
        return [
            (end, "" if len(variants) == every else ", ".join(variants))
            for end, variants in found.items()
        ]

    @property
    def parameters(self) -> type:
        """Its dataclass of parameters."""
        return self.variants[0][1].parameters[0]

    @property
    def parts(self) -> dict[str, list[str]]:
        """Parts of its diagnostics, with the keys of each."""
        found: dict[str, list[str]] = {}
        for _, record in self.variants:
            for part, keys in record.parts.items():
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
    """Construct every node of the rig in all its variants; return the records."""
    found = []
    with reserve_domain_id() as domain, tempfile.TemporaryDirectory() as scratch:
        for package, name, module_name in executables("node"):
            module = importlib.import_module(module_name)
            variants = [
                (variant.when, _record(module, variant, domain, Path(scratch, f"{name}_{number}")))
                for number, variant in enumerate(NODE_VARIANTS.get(name, (NodeVariant(),)))
            ]
            found.append(RigNode(name, package, module, variants))
    return found


def _record(module: ModuleType, variant: NodeVariant, domain: int, scratch: Path) -> NodeRecord:
    arguments = ["--ros-args", "--log-level", "fatal"]
    for parameter in variant.parameters:
        arguments += ["-p", parameter.format(scratch=scratch)]
    options = SignalHandlerOptions.NO
    rclpy.init(args=arguments, domain_id=domain, signal_handler_options=options)
    try:
        with record_nodes() as record:
            node = variant.make(module)
            try:
                variant.then(node, record)
            finally:
                getattr(node, "close", lambda: None)()
                node.destroy_node()
    finally:
        rclpy.try_shutdown()
    return record


def _class_of(module: ModuleType) -> Callable[[], Node]:
    """Return the constructor of a module's node: its class, or what `main` passes to `run_node`."""
    found = [
        each
        for each in vars(module).values()
        if inspect.isclass(each) and issubclass(each, Node) and each.__module__ == module.__name__
    ]
    if found:
        return found[0]
    run_node, find_spec = "needle_core.ros.main.run_node", "importlib.util.find_spec"
    # Topics and services do not depend on optional packages.
    with mock.patch(run_node, return_value=0) as run, mock.patch(find_spec):
        module.main()
    make: Callable[[], Node] = run.call_args.args[0]
    return make


def _spin(node: Any, _: NodeRecord) -> None:
    """Run the callbacks that are ready."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    for _turns in range(5):
        executor.spin_once(timeout_sec=0.0)
    executor.shutdown()


def _live_view(module: ModuleType) -> Node:
    """Construct the node with a stand-in for tf2_msgs."""
    kind = type(String)("TFMessage", (String,), {"__module__": "tf2_msgs.msg"})
    # mock.patch.dict would remove all modules that are imported meanwhile.
    sys.modules["tf2_msgs.msg"] = mock.Mock(TFMessage=kind)
    try:
        return _class_of(module)()
    finally:
        del sys.modules["tf2_msgs.msg"]


def _feed_messages(node: Any, record: NodeRecord) -> None:
    """Handle an empty message on every topic, images included."""
    for row in node.component.inputs:
        if row.lazy:
            node._listen(row.topic, True)
        message = from_ros(row.message, rclpy_types().make(ros_type(row.message))())
        node._handle(lambda row=row, message=message: row.handler(message, node._moment()))
    _run_timers(node, record)


def _console(_: ModuleType) -> Node:
    """Construct the console without its page, which needs NiceGUI and ports."""

    def make(settings: ConsoleParameters, _: str) -> Console:
        return Console(settings)

    return ComponentNode(
        Console.name, ConsoleParameters, make, lambda settings: {PAGE: PagePort(settings)}
    )


def _operate_page(node: Any, record: NodeRecord) -> None:
    desk = node._ports[PAGE]
    desk.view("left")
    for button in Button:
        if button in CALLS:
            desk.press(button)
    desk.set_hold(PageHold(True, 1.0, Mode.RETRACT))
    node._handle_arrived()
    for timer in node.component.timers:
        node._handle(lambda timer=timer: timer.handler(node._moment()))
    for service in ("device/retract", "plane_controller/stop"):
        node._execute(Call(service))


def _player(module: ModuleType, *more: str) -> Node:
    options = parse_options([str(BAG), *more])
    node: Node = module.Player(options, read_contents(BAG))
    return node


def _publish_and_check(node: Any, _: NodeRecord) -> None:
    node._make_publishers()
    node.check_graph()


def _report_and_close(node: Any, _: NodeRecord) -> None:
    node.report()
    node.recording.close()


def _run_timers(node: Any, record: NodeRecord) -> None:
    """Run every timer callback."""
    for timer in list(node.timers):
        timer.callback()
    _spin(node, record)


def _camera(module: ModuleType) -> Node:
    """Construct the camera node without a camera."""
    with mock.patch("needle_tracker.stereo_camera.open_source"):
        return _class_of(module)()


NODE_VARIANTS: dict[str, tuple[NodeVariant, ...]] = {
    "console": (NodeVariant(make=_console, then=_operate_page),),
    "device_driver": (NodeVariant(then=_run_timers),),
    "live_view": (NodeVariant(make=_live_view, then=_feed_messages),),
    "openigtlink": (NodeVariant("", ("port:=0",), then=_feed_messages),),
    "operator": (
        NodeVariant(
            "sources pedal and joystick", ("device:=/dev/null", "key:=48"), then=_run_timers
        ),
        NodeVariant("source joy", ("source:=joy", "key:=0"), then=_run_timers),
    ),
    "player": (
        NodeVariant(make=_player, then=_publish_and_check),
        NodeVariant(
            "with `--clock`",
            make=lambda module: _player(module, "--clock", "100"),
            then=_publish_and_check,
        ),
    ),
    "recorder": (
        NodeVariant("", ("bag:={scratch}",), then=_report_and_close),
        NodeVariant(
            "with `snapshot_seconds`",
            ("bag:={scratch}", "snapshot_seconds:=1.0"),
            then=_report_and_close,
        ),
    ),
    "sim_rig": (
        NodeVariant("level tip", ("level:=tip",), then=_run_timers),
        NodeVariant("level camera", ("level:=camera",), then=_run_timers),
        NodeVariant("level drive", ("level:=drive",), then=_run_timers),
    ),
    "simulated_operator": (
        NodeVariant(then=_run_timers),
        NodeVariant("with `wait_for_recorder`", ("wait_for_recorder:=true",)),
    ),
    "stereo_camera": (NodeVariant(make=_camera, then=_run_timers),),
    "stereo_tracker": (NodeVariant(then=_spin),),
    "tracked_tip": tuple(
        NodeVariant(
            f"source {source}",
            (f"registration_file:={REGISTRATION}", f"source:={source}"),
            then=_feed_messages,
        )
        for source in ("openigtlink_client", "pose", "transform")
    ),
}
"""Variants of the nodes that need parameters or have several."""
