"""Start, health and end of every node of the rig."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from needle_core.commands.cli import (
    EXIT_BAD_INPUT,
    EXIT_DONE,
    EXIT_INTERNAL_ERROR,
    internal_error,
    run_command,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.process.end_request import EndRequest
from needle_core.process.reach import keep_to_this_machine
from needle_core.process.shared_memory import remove_half_made_ports
from needle_core.ros.conversions import RELIABLE, to_diagnostic_status, to_stamp
from needle_core.ros.node_names import signature
from needle_core.settings.parameter_fields import describe
from needle_core.settings.parameter_files import given_sections

_LONGEST_TEXT = 200
_ROS_OPTIONS = ("-p", "--param", "--params-file", "-r", "--remap", "--log-level")
STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)
# An executor that waits does not see a signal: it looks up after this time [s].
LOOK_PERIOD = 0.1
# A subscriber that does not acknowledge for so long keeps no node from ending [s]: one that ends by
# itself (a recorder that stood still for 4 s acknowledged within 3 s), and after a signal.
_ACKNOWLEDGED_WITHIN, _ACKNOWLEDGED_AFTER_SIGNAL = 5.0, 0.5


class DiagnosticsPublisher:
    """Publishes a node's health on /diagnostics: once a second and whenever it changes.

    Parameters
    ----------
    node : Node
        The node whose health it is.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._refused: Counter[str] = Counter()
        self._complaints: set[tuple[str, str]] = set()
        self._parts: dict[str, Diagnostic] = {}
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        # Health is told also while simulated time stands still, hence the steady clock.
        node.create_timer(1.0, self._publish_all, clock=STEADY_CLOCK)

    def set(self, part: str, diagnostic: Diagnostic) -> None:
        """Take the health of one part; published at once where level or message changed."""
        before = self._parts.get(part)
        self._parts[part] = diagnostic
        if before is None or (before.level, before.message) != (
            diagnostic.level,
            diagnostic.message,
        ):
            self._publish([part])

    def refuse(self, source: str, kind: str, why: str) -> None:
        """Count and tell, as part `input`, what the node was sent and cannot use.

        Parameters
        ----------
        source : str
            Topic or service.
        kind : str
            What sort of trouble; the first of each is logged.
        why : str
            What is wrong with it.
        """
        text = f"{source}: refused: {why}"[:_LONGEST_TEXT]
        self._refused[source] += 1
        if (source, kind) not in self._complaints:
            self._complaints.add((source, kind))
            self._node.get_logger().warning(text)
        values = {f"refused {name}": str(count) for name, count in self._refused.items()}
        message = f"{source}: refused: {kind}"
        self.set("input", Diagnostic(Level.WARN, message, {"last": text, **values}))

    def _publish_all(self) -> None:
        self._publish(list(self._parts))

    def _publish(self, parts: list[str]) -> None:
        name = signature(self._node)
        message = DiagnosticArray()
        message.header.stamp = to_stamp(self._node.get_clock().now().nanoseconds)
        message.status = [
            to_diagnostic_status(f"{name}: {part}", name, self._parts[part]) for part in parts
        ]
        self._publisher.publish(message)


def run_node(
    create: Callable[[], Node],
    *,
    help_text: str,
    parameters: type,
    args: list[str] | None = None,
    spin: Callable[[Node, EndRequest], int] | None = None,
    shared_memory: bool = True,
) -> int:
    """Run a node until a signal ends it; `--help` explains it instead.

    Parameters
    ----------
    create : callable
        Makes the node, after rclpy is initialised.
    help_text : str
        What the node does, its topics and services: the first part of `--help`.
    parameters : type
        The node's parameter dataclass: the second part of `--help`.
    args : list of str, optional
        Command line with the program's name; sys.argv by default.
    spin : callable, optional
        Takes the node and the wish to end it, runs it until then and returns the exit code; by
        default nothing but spins.
    shared_memory : bool
        Whether messages may go through shared memory, as images must: see `keep_to_this_machine`.

    Returns
    -------
    int
        0 after a clean end (also by SIGINT, SIGTERM or SIGHUP), 2 after bad parameters or
        arguments, 3 after an internal error.
    """
    argv = list(sys.argv if args is None else args)
    with EndRequest() as end:
        try:
            # rclpy reads the files, too, but its errors do not say what is wrong with them.
            given_sections(argv)
            own = remove_ros_args(argv)[1:]
            if own in (["--help"], ["-h"]):
                return run_command(lambda: _explain(help_text, parameters))
            # rcl takes NAME:=VALUE for a remapping, as of old: no parameter would be set.
            before = argv[1 : argv.index("--ros-args")] if "--ros-args" in argv else argv[1:]
            own = own or [argument for argument in before if ":=" in argument]
            if own:
                raise UserError(f"unknown argument {own[0]!r}; {_hint(own[0])}")
            keep_to_this_machine(shared_memory=shared_memory)
            remove_half_made_ports()
            # rclpy's own handlers would shut the context down in the middle of what is under way.
            rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
        # rclpy raises its own private types for a bad command line
        except Exception as error:  # noqa: BLE001
            return _refuse(error)
        return _run(create, spin or _spin, end)


def _hint(argument: str) -> str:
    if ":=" in argument:
        return f"a parameter is set by --ros-args -p {argument}"
    return "it goes after --ros-args" if argument in _ROS_OPTIONS else "see --help"


def _run(
    create: Callable[[], Node], spin: Callable[[Node, EndRequest], int], end: EndRequest
) -> int:
    node: Node | None = None
    code = EXIT_INTERNAL_ERROR
    try:
        node = create()
        code = spin(node, end)
    except (UserError, ParameterException) as error:
        code = _refuse(error)
        if end.wanted:
            # Others end on the same signal: what was missed from them is no bad input.
            code = EXIT_DONE
    except Exception as error:  # noqa: BLE001
        # No node: its name, namespace or surroundings are not what ROS takes.
        is_refused = node is None and isinstance(error, rclpy_implementation.RCLError)
        code = _refuse(error) if is_refused else internal_error(error)
    finally:
        if node is not None and node.context.ok():
            _wait_for_acknowledgements(
                node, _ACKNOWLEDGED_AFTER_SIGNAL if end.wanted else _ACKNOWLEDGED_WITHIN
            )
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def _wait_for_acknowledgements(node: Node, seconds: float) -> None:
    """Wait until all reliable subscribers have the node's messages: it takes the rest with it.

    A busy recorder would miss the end of a run, and could not tell.
    """
    until = time.monotonic() + seconds
    for publisher in node.publishers:
        left = max(until - time.monotonic(), 0.0)
        publisher.wait_for_all_acked(Duration(seconds=left))


def _explain(help_text: str, parameters: type) -> int:
    print(f"{help_text.strip()}\n\nParameters (--ros-args -p NAME:=VALUE):")
    print(describe(parameters))
    return EXIT_DONE


def _spin(node: Node, end: EndRequest) -> int:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        while not end.wanted:
            executor.spin_once(timeout_sec=LOOK_PERIOD)
    finally:
        # One that outlives the context complains when it is collected.
        executor.shutdown()
    return EXIT_DONE


def _refuse(error: Exception) -> int:
    print(f"error: {_first_line(error)}", file=sys.stderr)
    return EXIT_BAD_INPUT


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
