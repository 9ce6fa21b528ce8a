"""Components of all nodes of the rig, in each variant with different topics or services."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from types import ModuleType
from typing import Any
from unittest import mock

from code_lines import ROOT
from needle_bags.link.openigtlink import LINK, Listeners
from needle_bags.ros.player import PlayerParameters
from needle_bags.ros.recorder import PARAMETERS_OF, RecorderParameters
from needle_bringup.operator.component import DEVICE_STOP
from needle_console.console import CALLS as OF_BUTTONS
from needle_console.console import PAGE, HoldRequest
from needle_console.hold.page_session import RELEASED
from needle_core.component import Action, Call, Component, Diagnose, Moment, Peers
from needle_core.convert import from_ros, ros_type
from needle_core.message_types import rclpy_types
from needle_core.retraction import RETRACT, STOP_STEERING
from needle_core.runners.process import Handlers
from reference.endpoints import CALLS, PUBLISHES, SERVES, SOURCES, Endpoint, endpoints_of, service

REGISTRATION = ROOT / "ros2_ws/src/needle_tracker/test/data/registration.yaml"
IN_EVERY_NODE = {
    "input": "a message or request was rejected; counted by topic",
    "handlers": "a handler failed; counted",
    "duplicates": "another node publishes on a topic of this node",
}
"""Diagnostic parts that any node may report, through `needle_core.ros`."""


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
    """Make the component of every node in all its variants, and run its handlers."""
    found = [*NOT_COMPONENTS]
    for package, name, module_name in executables("node"):
        if any(name == node.name for node in NOT_COMPONENTS):
            continue
        module = importlib.import_module(module_name)
        parameters, make = _of_component(module)
        variants: dict[str, list[Endpoint]] = {}
        parts: dict[str, list[str]] = {}
        for when, values in VARIANTS.get(name, {"": {}}).items():
            component = make(parameters(**values), name)
            calls = [service(CALLS, called) for called in LATER_CALLS.get(name, ())]
            for action in _actions(component):
                match action:
                    case Call():
                        calls.append(
                            service(CALLS, action.service, has_argument=action.request is not None)
                        )
                    case Diagnose(part, diagnostic) if part not in IN_EVERY_NODE:
                        keys = parts.setdefault(part, [])
                        keys += [key for key in diagnostic.values if key not in keys]
            variants[when] = list(dict.fromkeys((*endpoints_of(component), *calls)))
        found.append(RigNode(name, package, module, parameters, variants, parts))
    return sorted(found, key=lambda node: (node.package, node.name))


def _of_component(module: ModuleType) -> tuple[type, Callable[[Any, str], Component]]:
    """Return the parameters and the factory that the `main` of a node's module runs."""
    with (
        mock.patch.object(module, "run_component", return_value=0) as run,
        # Treat optional packages as installed, because the page must not depend on them.
        mock.patch("importlib.util.find_spec"),
        mock.patch.dict("sys.modules", {"needle_console.page.web_server": mock.Mock()}),
    ):
        module.main()
    _, parameters, make = run.call_args.args
    return parameters, make


def _actions(component: Component) -> Iterator[Action]:
    """Yield the actions after an empty message on every topic, and of every port and timer."""
    handlers, at = Handlers(component.outputs), Moment(time.monotonic(), time.time_ns())
    yield from handlers.run(partial(component.on_peers, Peers.of([component]), at))
    for row in component.inputs:
        message = from_ros(row.message, rclpy_types().make(ros_type(row.message))())
        yield from handlers.run(partial(row.handler, message, at))
    for port in component.ports:
        for batch in ARRIVING.get(port.name, ()):
            yield from handlers.run(partial(port.handler, batch, at))
    for timer in component.timers:
        yield from handlers.run(partial(timer.handler, at))


LATER_CALLS = {
    "console": (STOP_STEERING, RETRACT),
    "operator": (DEVICE_STOP, STOP_STEERING, RETRACT),
}
"""Calls that depend on buttons and on the answers of other nodes, by node."""
ARRIVING: Mapping[str, Sequence[tuple[Any, ...]]] = {
    LINK: ((Listeners(1),),),
    PAGE: (tuple(OF_BUTTONS), (HoldRequest(RELEASED),)),
}
"""Batches that arrive at a port, by its name."""
VARIANTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "operator": {
        "sources pedal and joystick": {"device": "/dev/null", "key": 48},
        "source joy": {"source": "joy", "key": 0},
    },
    "sim_rig": {f"level {level}": {"level": level} for level in ("tip", "camera", "drive")},
    "simulated_operator": {
        "": {},
        "with `wait_for_recorder`": {"wait_for_recorder": True},
    },
    "tracked_tip": {
        f"source {source}": {"registration_file": str(REGISTRATION), "source": source}
        for source in ("openigtlink_client", "pose", "transform")
    },
}
"""Parameters of nodes that need some, or have several variants, by description."""
_PAUSE = service(SERVES, "player/pause", has_argument=True)
NOT_COMPONENTS = (
    RigNode(
        "recorder",
        "needle_bags",
        importlib.import_module("needle_bags.ros.recorder"),
        RecorderParameters,
        {"": [], "with `snapshot_seconds`": [service(SERVES, "recorder/snapshot")]},
        {
            "bag": [
                *("bag", "topics", "messages", "messages_waiting", "messages_lost", "size_bytes"),
                *("in_memory_s", "in_memory_bytes"),
            ],
            PARAMETERS_OF: [],
        },
    ),
    RigNode(
        "player",
        "needle_bags",
        importlib.import_module("needle_bags.ros.player"),
        PlayerParameters,
        {
            "": [_PAUSE],
            "with `--clock`": [
                _PAUSE,
                Endpoint(PUBLISHES, "/clock", "rosgraph_msgs/Clock", "reliable, 10"),
            ],
        },
        {"playback": ["bag", "messages"]},
    ),
)
"""Nodes whose topics depend on the graph or a bag."""
