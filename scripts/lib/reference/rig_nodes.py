"""Construction of every node of the rig, in each variant with different topics or services."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import inspect
import sys
import tempfile
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any
from unittest import mock

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from code_lines import ROOT
from needle_console.console import CALLS, PAGE
from needle_console.hold.page_session import Mode, PageHold
from needle_console.page.page_port import PagePort
from needle_console.view.advice import Button
from needle_core.component import Call
from needle_core.convert import from_ros, ros_type
from needle_core.diagnostics import Diagnostic
from needle_core.message_types import rclpy_types
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.ros import main
from needle_core.ros.base_node import DiagnosticsPublisher
from reference.endpoints import NAMESPACE, SOURCES, Endpoint, endpoints_of

BAG = ROOT / "bags" / "regression"
REGISTRATION = ROOT / "ros2_ws/src/needle_tracker/test/data/registration.yaml"
IN_EVERY_NODE = {
    "input": "a message or request was rejected; counted by topic",
    "handlers": "a handler failed; counted",
    "duplicates": "another node publishes on a topic of this node",
}
"""Diagnostic parts that any node may report, through `needle_core.ros`."""
_WEB_SERVER = "needle_console.page.web_server"


def executables(kind: str) -> Iterator[tuple[str, str, str]]:
    """Yield (package, executable, module) of all executables of a kind, `node` or `command`."""
    for folder in sorted(SOURCES.iterdir()):
        if not (folder / folder.name / "executables.py").is_file():
            continue
        module = importlib.import_module(f"{folder.name}.executables")
        for name, enter in sorted(vars(module).items()):
            if getattr(enter, "__qualname__", "") == f"{kind}.<locals>.enter":
                yield folder.name, name, inspect.getclosurevars(enter).nonlocals["module"]


@dataclasses.dataclass(frozen=True)
class RigNode:
    """Node of the rig.

    Attributes
    ----------
    name, package : str
        Executable and package.
    module : ModuleType
        Module of the node.
    parameters : type
        Dataclass of its parameters.
    variants : dict of str to list of Endpoint
        Endpoints by description of the variant.
    parts : dict of str to list of str
        Parts of its diagnostics, with the keys of each part's values.
    """

    name: str
    package: str
    module: ModuleType
    parameters: type
    variants: dict[str, list[Endpoint]]
    parts: dict[str, list[str]]

    def endpoints(self, *roles: str) -> list[tuple[Endpoint, str]]:
        """Return each endpoint with the variants that have it; empty text if all do."""
        found: dict[Endpoint, list[str]] = {}
        for when, ends in self.variants.items():
            for end in ends:
                if end.role in roles:
                    found.setdefault(end, []).append(when)
        every = len(self.variants)
        return [
            (end, "" if len(variants) == every else ", ".join(variants))
            for end, variants in found.items()
        ]

    @property
    def help(self) -> str:
        """Text of the node's `--help`, without the parameters."""
        return str(getattr(self.module, "HELP", "")).strip("\n")


def rig_nodes() -> list[RigNode]:
    """Construct every node of the rig in all its variants, and run its callbacks."""
    found = []
    with reserve_domain_id() as domain:
        for package, name, module_name in executables("node"):
            module = importlib.import_module(module_name)
            variants: dict[str, list[Endpoint]] = {}
            parts: dict[str, list[str]] = {}
            for when, arguments in VARIANTS.get(name, {"": ""}).items():
                parameters, variants[when] = _construct(module, arguments, domain, parts)
            found.append(RigNode(name, package, module, parameters, variants, parts))
    return found


def _construct(
    module: ModuleType, arguments: str, domain: int, parts: dict[str, list[str]]
) -> tuple[type, list[Endpoint]]:
    """Construct a node and run its callbacks; return its parameters and endpoints.

    The parts of its diagnostics are added to `parts`.
    """
    report = DiagnosticsPublisher.set

    def report_and_note(self: Any, part: str, diagnostic: Diagnostic) -> None:
        if part not in IN_EVERY_NODE:
            keys = parts.setdefault(part, [])
            keys += [key for key in diagnostic.values if key not in keys]
        report(self, part, diagnostic)

    own, _, ros = arguments.partition("--ros-args")
    with (
        tempfile.TemporaryDirectory() as scratch,
        _replaced_web_server(),
        # Avoid opening a camera.
        mock.patch("needle_tracker.stereo_camera.open_source"),
        mock.patch.object(DiagnosticsPublisher, "set", report_and_note),
    ):
        made = _made_by_main(module, own.split())
        ros_arguments = ["--ros-args", "--log-level", "fatal", "-r", f"__ns:={NAMESPACE}"]
        ros_arguments += ros.format(scratch=scratch).split()
        options = SignalHandlerOptions.NO
        rclpy.init(args=ros_arguments, domain_id=domain, signal_handler_options=options)
        try:
            node = made.args[0]()
            try:
                EXERCISES.get(node.get_name(), _exercise)(node)
                return made.kwargs["parameters"], endpoints_of(node)
            finally:
                getattr(node, "close", lambda: None)()
                node.destroy_node()
        finally:
            rclpy.try_shutdown()


@contextlib.contextmanager
def _replaced_web_server() -> Iterator[None]:
    """Replace the console's page, which requires NiceGUI."""
    # mock.patch.dict would remove all modules that are imported in the meantime.
    before = sys.modules.pop(_WEB_SERVER, None)
    sys.modules[_WEB_SERVER] = mock.Mock(ServedPagePort=PagePort)
    yield
    del sys.modules[_WEB_SERVER]
    if before is not None:
        sys.modules[_WEB_SERVER] = before


def _made_by_main(module: ModuleType, arguments: list[str]) -> Any:
    """Return the call of `run_node` that the `main` of a node's module makes."""
    with (
        mock.patch.object(main, "run_node", return_value=0) as run,
        mock.patch.object(module, "run_node", run, create=True),
        mock.patch.object(sys, "argv", [module.__name__, *arguments]),
        # Treat optional packages as installed, because the page must not depend on them.
        mock.patch("importlib.util.find_spec"),
    ):
        module.main()
    return run.call_args


def _exercise(node: Any) -> None:
    """Handle an empty message on every topic, images included, and run every timer."""
    for row in node.component.inputs:
        message = from_ros(row.message, rclpy_types().make(ros_type(row.message))())
        node._handle(lambda row=row, message=message: row.handler(message, node._moment()))
    for timer in list(node.timers):
        timer.callback()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    for _turns in range(5):
        executor.spin_once(timeout_sec=0.0)
    executor.shutdown()
    for row in node.component.inputs:
        node._listen(row.topic, row.lazy)


def _exercise_console(node: Any) -> None:
    """Press every button of the page."""
    page = node._ports[PAGE]
    page.view("left")
    for button in Button:
        if button in CALLS:
            page.press(button)
    page.set_hold(PageHold(True, 1.0, Mode.RETRACT))
    node._handle_arrived()
    for timer in node.component.timers:
        node._handle(lambda timer=timer: timer.handler(node._moment()))
    for service in ("device/retract", "plane_controller/stop"):
        node._execute(Call(service))


def _exercise_player(node: Any) -> None:
    """Publish the time, but no topic of the bag."""
    node._topics.clear()
    node._make_publishers()
    node.check_graph()


def _exercise_recorder(node: Any) -> None:
    """Publish a report, and unsubscribe from all topics of the graph."""
    node.report()
    node.recording.close()
    node._topics.unsubscribe()


EXERCISES: dict[str, Callable[[Any], None]] = {
    "console": _exercise_console,
    "player": _exercise_player,
    "recorder": _exercise_recorder,
}
VARIANTS = {
    "openigtlink": {"": "--ros-args -p port:=0"},
    "operator": {
        "sources pedal and joystick": "--ros-args -p device:=/dev/null -p key:=48",
        "source joy": "--ros-args -p source:=joy -p key:=0",
    },
    "player": {"": f"{BAG}", "with `--clock`": f"{BAG} --clock 100"},
    "recorder": {
        "": "--ros-args -p bag:={scratch}/bag",
        "with `snapshot_seconds`": "--ros-args -p bag:={scratch}/bag -p snapshot_seconds:=1.0",
    },
    "sim_rig": {
        f"level {level}": f"--ros-args -p level:={level}" for level in ("tip", "camera", "drive")
    },
    "simulated_operator": {
        "": "",
        "with `wait_for_recorder`": "--ros-args -p wait_for_recorder:=true",
    },
    "tracked_tip": {
        f"source {source}": (f"--ros-args -p registration_file:={REGISTRATION} -p source:={source}")
        for source in ("openigtlink_client", "pose", "transform")
    },
}
"""Command lines of nodes that need parameters or have several variants, by description."""
