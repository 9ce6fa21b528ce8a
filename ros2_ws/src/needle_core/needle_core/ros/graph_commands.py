"""Graph commands of the small `ros2`: node, topic, service and param."""

from __future__ import annotations

import argparse
import array
import importlib
import itertools
import os
import re
import sys
import time
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import numpy as np
import rclpy
import yaml
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter, get_parameter_value, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from needle_core.errors import UserError
from needle_core.files.yaml_files import load_yaml
from needle_core.ros.base_node import full_name, spin_until

# Time to discover all endpoints, to discover a given node or topic, and for an answer [s].
DISCOVERY, SEARCH_TIMEOUT, ANSWER_TIMEOUT = 1.0, 5.0, 10.0
MAX_LENGTH = 128  # maximum number of printed elements of an array, or characters of a string


# ---- messages ---------------------------------------------------------------------------------


def find_type(name: str, kind: str) -> Any:
    """Return the class of `sensor_msgs/msg/Joy` or `sensor_msgs/Joy`; `kind` is `msg` or `srv`."""
    package, _, type_name = name.replace(f"/{kind}/", "/").partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), type_name)
    except (AttributeError, ModuleNotFoundError) as error:
        raise UserError(f"there is no {kind} type '{name}'") from error


def to_plain(value: Any) -> Any:
    """Return a message, or a field of one, as plain data; long strings and arrays are shortened."""
    is_longer = hasattr(value, "__len__") and len(value) > MAX_LENGTH
    if isinstance(value, (str, bytes)):
        text = value if isinstance(value, str) else value.decode("latin-1")
        return text[:MAX_LENGTH] + "..." * is_longer
    if isinstance(value, (list, array.array, np.ndarray)):
        return [to_plain(item) for item in value[:MAX_LENGTH]] + ["..."] * is_longer
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "get_fields_and_field_types"):
        return {name: to_plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    return value


def fill(message: Any, values: Any) -> list[Any]:
    """Set the fields of a message from plain data; return the stamps that were given as `now`."""
    if not isinstance(values, Mapping):
        raise UserError(f"'{values}' is expected to be a dictionary")
    stamps: list[Any] = []
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        if name not in types:
            raise UserError(f"'{type(message).__name__}' has no field '{name}'")
        field = getattr(message, name)
        if types[name] == "builtin_interfaces/Time" and value == "now":
            stamps.append(field)
        elif hasattr(field, "get_fields_and_field_types"):
            stamps += fill(field, value)
        else:
            try:
                setattr(message, name, _converted(value, types[name], stamps))
            except (AssertionError, TypeError, ValueError, OverflowError) as error:
                raise UserError(f"{name}: {value!r} is not a {types[name]}") from error
    return stamps


def _converted(value: Any, type_name: str, stamps: list[Any]) -> Any:
    """Convert a value to the messages and floats of its field; add the messages' stamps."""
    if isinstance(value, list):
        item_type = re.sub(r"^sequence<|[,<>\[].*$", "", type_name)
        return [_converted(item, item_type, stamps) for item in value]
    if "/" in type_name:
        message = find_type(type_name, "msg")()
        stamps += fill(message, value)
        return message
    # Other conversions, such as a string to a number, could hide a mistake.
    return float(value) if type_name in ("float", "double") and type(value) is int else value


# ---- commands ---------------------------------------------------------------------------------


def list_names(node: Node, options: argparse.Namespace) -> None:
    """Print the names of the topics, or of the nodes except hidden ones (that of this command)."""
    spin_until(node, bool, DISCOVERY)
    nodes = node.get_node_names_and_namespaces()
    names = [full_name(space, name) for name, space in nodes if name[0] != "_"]
    if options.command == "topic list":
        names = [name for name, _ in node.get_topic_names_and_types()]
    print("\n".join(sorted(names)))


def echo(node: Node, options: argparse.Namespace) -> None:
    """Print the messages of a topic."""
    topic = node.resolve_topic_name(options.topic_name)
    unknown = f"topic [{options.topic_name}] is not published"
    spin_until(node, lambda: node.count_publishers(topic), SEARCH_TIMEOUT, unknown)
    offered = node.get_publishers_info_by_topic(topic)
    qos = QoSProfile(depth=10)
    if any(one.qos_profile.reliability != ReliabilityPolicy.RELIABLE for one in offered):
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
    if all(one.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in offered):
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
    printed: list[bool] = []

    def show(message: Any) -> None:
        # As in the original command, the filter is Python code of the user.
        is_selected = options.filter is None or eval(options.filter, {"m": message})
        if not is_selected or (options.once and printed):
            return
        value = to_plain(attrgetter(options.field)(message) if options.field else message)
        is_nested = isinstance(value, (dict, list))
        text = yaml.safe_dump(value, width=1 << 30, sort_keys=False) if is_nested else f"{value}\n"
        print(text, end="---\n", flush=True)
        printed.append(True)

    node.create_subscription(find_type(offered[0].topic_type, "msg"), topic, show, qos)
    spin_until(node, lambda: printed and options.once, options.timeout)


def pub(node: Node, options: argparse.Namespace) -> None:
    """Publish a message once, a number of times, or until interrupted."""
    message = find_type(options.message_type, "msg")()
    stamps = fill(message, load_yaml(options.values))
    # Transient local matches every subscriber, including those of targets.
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(type(message), options.topic_name, latched)
    if options.times:
        spin_until(node, publisher.get_subscription_count, float("inf"))
    print("publisher: beginning loop", flush=True)
    due = time.monotonic()
    for count in itertools.count(1):
        now = node.get_clock().now().to_msg()
        for stamp in stamps:
            stamp.sec, stamp.nanosec = now.sec, now.nanosec
        if options.print and count % options.print == 0:
            print(f"publishing #{count}: {message!r}\n", flush=True)
        publisher.publish(message)
        if count == options.times:
            break
        due = max(due + 1.0 / options.rate, time.monotonic())
        spin_until(node, bool, due - time.monotonic())
    spin_until(node, bool, 0.1)  # until the last message has left


def call(node: Node, options: argparse.Namespace) -> None:
    """Call a service and print its answer."""
    service = find_type(options.service_type, "srv")
    fill(request := service.Request(), load_yaml(options.values))
    client = node.create_client(service, options.service_name)
    spin_until(node, client.service_is_ready, float("inf"))
    print(f"requester: making request: {request!r}\n", flush=True)
    print(f"response:\n{_answer(node, options.service_name, client.call_async(request))!r}\n")


def _answer(node: Node, server: str, future: Any) -> Any:
    spin_until(node, future.done, ANSWER_TIMEOUT, f"no answer from {server}")
    return future.result()


def _parameter_client(node: Node, options: argparse.Namespace) -> AsyncParameterClient:
    client = AsyncParameterClient(node, "/" + options.node_name.lstrip("/"))
    spin_until(node, client.services_are_ready, SEARCH_TIMEOUT, "Node not found")
    return client


def get_parameter(node: Node, options: argparse.Namespace) -> None:
    """Print the value of a parameter."""
    future = _parameter_client(node, options).get_parameters([options.parameter_name])
    values = _answer(node, options.node_name, future).values
    kind = Parameter.Type(values[0].type if values else 0)
    if kind is Parameter.Type.NOT_SET:
        raise UserError("Parameter not set")
    print(f"{kind.name.capitalize()} value is: {parameter_value_to_python(values[0])}")


def set_parameter(node: Node, options: argparse.Namespace) -> None:
    """Set a parameter; the exit code is 1 if the node rejects it."""
    value = parameter_value_to_python(get_parameter_value(options.value))
    parameters = [Parameter(options.parameter_name, value=value)]
    future = _parameter_client(node, options).set_parameters(parameters)
    (result,) = _answer(node, options.node_name, future).results
    if not result.successful:
        raise UserError(f"Setting parameter failed: {result.reason}")
    print("Set parameter successful")


# ---- command line -----------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="ros2", allow_abbrev=False)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, action: Callable[..., None], *arguments: str) -> Any:
        added = commands.add_parser(name, description=action.__doc__)
        added.set_defaults(action=action, command=name)
        for argument in arguments:
            added.add_argument(argument)
        return added.add_argument

    command("node list", list_names)
    command("topic list", list_names)
    add = command("topic echo", echo, "topic_name")
    add("--filter", metavar="EXPR", help="Python expression of the message m")
    add("--field", help="field of the message; sub-fields after a dot")
    add("--once", action="store_true", help="print one message and exit")
    add("--timeout", type=float, default=float("inf"), metavar="N", help="exit after N seconds")
    add = command("topic pub", pub, "topic_name", "message_type")
    add("values", nargs="?", default="{}", help="YAML; `now` is the time of sending")
    add("-r", "--rate", type=float, default=1.0, metavar="N", help="rate [Hz]")
    add("-p", "--print", type=int, default=1, metavar="N", help="print every N-th message")
    add("-1", "--once", action="store_const", dest="times", const=1)
    add("-t", "--times", type=int, default=0, metavar="N")
    add = command("service call", call, "service_name", "service_type")
    add("values", nargs="?", default="{}", help="the request as YAML")
    command("param get", get_parameter, "node_name", "parameter_name")
    command("param set", set_parameter, "node_name", "parameter_name", "value")
    return parser


def main(arguments: list[str]) -> int:
    """Run the command, such as `topic list`; return the exit code."""
    options = _parser().parse_args([" ".join(arguments[:2]), *arguments[2:]])
    rclpy.init(args=[])
    try:
        options.action(Node(f"_ros2cli_{os.getpid()}", start_parameter_services=False), options)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    except (UserError, AttributeError, ValueError, NameValidationException) as error:
        print(str(error).splitlines()[0], file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0
