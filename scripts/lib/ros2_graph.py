"""Commands of the small `ros2` in a running graph: topic, service, param and node.

The syntax and the output are those of ROS 2's own command line, as far as it goes.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

import rclpy
from rclpy.exceptions import InvalidServiceNameException, InvalidTopicNameException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter, get_parameter_value, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from ros2_messages import BadMessageError, fill, find_type, parse
from ros2_spinning import ANSWER, PATIENCE, SPIN_TIME, GraphError, spin_until
from ros2_topics import echo, hz, pub

HIDDEN = "_"
LABELS = {
    Parameter.Type.BOOL: "Boolean value is:",
    Parameter.Type.INTEGER: "Integer value is:",
    Parameter.Type.DOUBLE: "Double value is:",
    Parameter.Type.STRING: "String value is:",
    Parameter.Type.BYTE_ARRAY: "Byte values are:",
    Parameter.Type.BOOL_ARRAY: "Boolean values are:",
    Parameter.Type.INTEGER_ARRAY: "Integer values are:",
    Parameter.Type.DOUBLE_ARRAY: "Double values are:",
    Parameter.Type.STRING_ARRAY: "String values are:",
}


def list_topics(node: Node, options: argparse.Namespace) -> None:
    """Print the topics' names."""
    _print_names(node, node.get_topic_names_and_types, options)


def list_services(node: Node, options: argparse.Namespace) -> None:
    """Print the services' names."""
    _print_names(node, node.get_service_names_and_types, options)


def _print_names(node: Node, ask: Callable[[], Any], options: argparse.Namespace) -> None:
    spin_until(node, lambda: False, options.spin_time)
    for name, types in ask():
        if not topic_or_service_is_hidden(name):
            print(f"{name} [{', '.join(types)}]" if options.show_types else name)


# ---- services and parameters ------------------------------------------------------------------


def call(node: Node, options: argparse.Namespace) -> None:
    """Call a service and print its answer."""
    service_type = find_type(options.service_type, "srv")
    request = service_type.Request()
    fill(request, parse(options.values))
    client = node.create_client(service_type, options.service_name)
    if not spin_until(node, client.service_is_ready, SPIN_TIME):
        print("waiting for service to become available...", flush=True)
        spin_until(node, client.service_is_ready, float("inf"))
    print(f"requester: making request: {request!r}\n", flush=True)
    response = _answer(node, options.service_name, client.call_async(request))
    print(f"response:\n{response!r}\n")


def _node_names(node: Node, hidden: bool) -> list[str]:
    return sorted(
        f"{namespace.rstrip('/')}/{name}"
        for name, namespace in node.get_node_names_and_namespaces()
        if hidden or not name.startswith(HIDDEN)
    )


def list_nodes(node: Node, options: argparse.Namespace) -> None:
    """Print the nodes' names."""
    spin_until(node, lambda: False, options.spin_time)
    names = _node_names(node, False)
    if len(set(names)) < len(names):
        print(
            "WARNING: Be aware that there are nodes in the graph that share an exact name, which "
            "can have unintended side effects.",
            file=sys.stderr,
        )
    for name in names:
        print(name)


def _parameters_of(node: Node, name: str, timeout: float) -> AsyncParameterClient:
    full_name = name if name.startswith("/") else f"/{name}"
    if not spin_until(node, lambda: full_name in _node_names(node, True), timeout):
        raise GraphError("Node not found")
    client = AsyncParameterClient(node, full_name)
    if not spin_until(node, client.services_are_ready, PATIENCE):
        raise GraphError(
            f"Wait for service timed out waiting for parameter services for node {name}"
        )
    return client


def _answer(node: Node, asked: str, future: Any) -> Any:
    if not spin_until(node, future.done, ANSWER):
        raise GraphError(f"no answer from {asked}")
    return future.result()


def list_parameters(node: Node, options: argparse.Namespace) -> None:
    """Print the parameters' names, of one node or of all."""
    if not options.node_name:
        spin_until(node, lambda: False, options.spin_time)
    for name in [options.node_name] if options.node_name else _node_names(node, False):
        client = _parameters_of(node, name, PATIENCE)
        names = sorted(_answer(node, name, client.list_parameters()).result.names)
        if names and not options.node_name:
            print(f"{name}:")
        for parameter in names:
            print(f"  {parameter}")


def get_parameter(node: Node, options: argparse.Namespace) -> None:
    """Print a parameter's value."""
    client = _parameters_of(node, options.node_name, options.timeout)
    asked = client.get_parameters([options.parameter_name])
    values = _answer(node, options.node_name, asked).values
    if not values:
        raise GraphError("Parameter not set")
    label = LABELS.get(Parameter.Type(values[0].type))
    if label is None:
        print("Parameter not set.")
        return
    value = parameter_value_to_python(values[0])
    print(value) if options.hide_type else print(label, value)


def set_parameter(node: Node, options: argparse.Namespace) -> None:
    """Set a parameter and print whether the node took it."""
    client = _parameters_of(node, options.node_name, options.timeout)
    value = parameter_value_to_python(get_parameter_value(options.value))
    parameter = Parameter(options.parameter_name, value=value)
    (result,) = _answer(node, options.node_name, client.set_parameters([parameter])).results
    reason = f": {result.reason}" if result.reason else ""
    if result.successful:
        print(f"Set parameter successful{reason}")
    else:
        # The real one ends with 0 here too.
        print(f"Setting parameter failed{reason}", file=sys.stderr)


# ---- the command line -------------------------------------------------------------------------


def command_parser() -> argparse.ArgumentParser:
    """Return the parser of `ros2 topic|service|param|node ...`."""
    parser = argparse.ArgumentParser(prog="ros2", allow_abbrev=False)
    groups = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_topic_commands(_verbs(groups, "topic"))
    _add_other_commands(groups)
    return parser


def _verbs(groups: Any, name: str) -> Any:
    group = groups.add_parser(name)
    return group.add_subparsers(required=True, metavar="VERB")


def _command(verbs: Any, name: str, action: Callable[..., None]) -> argparse.ArgumentParser:
    text = action.__doc__
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=text, description=text)
    parser.set_defaults(action=action)
    parser.add_argument("--spin-time", type=float, default=SPIN_TIME, help="for discovery [s]")
    return parser


def _add_topic_commands(verbs: Any) -> None:
    command = _command(verbs, "list", list_topics)
    command.add_argument("-t", "--show-types", action="store_true")
    command = _command(verbs, "echo", echo)
    command.add_argument("topic_name")
    command.add_argument("--filter", metavar="EXPR", help="in Python, of the message m")
    command.add_argument("--field", help="of the message; sub-fields after a dot")
    command.add_argument("--once", action="store_true", help="print one message and end")
    command.add_argument("--timeout", type=_positive, metavar="N", help="end after N seconds")
    _command(verbs, "hz", hz).add_argument("topic_name")
    command = _command(verbs, "pub", pub)
    command.add_argument("topic_name")
    command.add_argument("message_type")
    command.add_argument("values", nargs="?", default="{}", help="YAML; `now` is a time as sent")
    command.add_argument("-r", "--rate", type=_positive, default=1.0, metavar="N", help="[Hz]")
    command.add_argument("-p", "--print", type=int, default=1, metavar="N", help="every N-th")
    count = command.add_mutually_exclusive_group()
    count.add_argument("-1", "--once", action="store_true")
    count.add_argument("-t", "--times", type=int, default=0, metavar="N")


def _add_other_commands(groups: Any) -> None:
    verbs = _verbs(groups, "service")
    command = _command(verbs, "list", list_services)
    command.add_argument("-t", "--show-types", action="store_true")
    command = _command(verbs, "call", call)
    command.add_argument("service_name")
    command.add_argument("service_type")
    command.add_argument("values", nargs="?", default="{}", help="the request as YAML")
    verbs = _verbs(groups, "node")
    _command(verbs, "list", list_nodes)
    verbs = _verbs(groups, "param")
    command = _command(verbs, "list", list_parameters)
    command.add_argument("node_name", nargs="?")
    for name, action in (("get", get_parameter), ("set", set_parameter)):
        command = _command(verbs, name, action)
        command.add_argument("node_name")
        command.add_argument("parameter_name")
        if name == "set":
            command.add_argument("value")
        else:
            command.add_argument("--hide-type", action="store_true")
        command.add_argument("--timeout", type=_positive, default=PATIENCE, metavar="N")


def _positive(text: str) -> float:
    value = float(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError("Value must be positive")
    return value


@contextlib.contextmanager
def own_node() -> Iterator[Node]:
    """Make a node whose name is hidden, for as long as the context lasts."""
    rclpy.init(args=[])
    node = Node(f"_ros2cli_{os.getpid()}", start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def main(arguments: list[str]) -> int:
    """Do what the command line says; returns the exit code of the real `ros2`."""
    options = command_parser().parse_args(arguments)
    try:
        with own_node() as node:
            options.action(node, options)
    except KeyboardInterrupt:
        return int(signal.SIGINT)
    except ExternalShutdownException:
        return int(signal.SIGTERM)
    except (GraphError, BadMessageError) as error:
        print(error, file=sys.stderr)
        return 1
    except (InvalidTopicNameException, InvalidServiceNameException) as error:
        print(str(error).splitlines()[0], file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
