"""How every node of the rig starts, reports its health and ends."""

from __future__ import annotations

import sys
from collections.abc import Callable

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from needle_common.cli import EXIT_BAD_INPUT, EXIT_DONE, internal_error, run_command
from needle_common.conversions import RELIABLE, to_diagnostic_status
from needle_common.diagnostics import Diagnostic
from needle_common.errors import UserError
from needle_common.parameter_fields import describe
from needle_common.partners_node import signature
from needle_common.reach import keep_to_this_machine
from needle_common.shared_memory import make_private

STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)


class DiagnosticsPublisher:
    """Publishes a node's health on /diagnostics: once a second and whenever it changes.

    Parameters
    ----------
    node : Node
        The node whose health it is.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
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

    def _publish_all(self) -> None:
        self._publish(list(self._parts))

    def _publish(self, parts: list[str]) -> None:
        name = signature(self._node)
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
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
    spin: Callable[[Node], int] | None = None,
    signal_handlers: SignalHandlerOptions = SignalHandlerOptions.ALL,
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
        Takes the node, runs it and returns the exit code; by default spins until shut down.
    signal_handlers : SignalHandlerOptions, optional
        rclpy's handlers; NO for a node that has last messages to send and handles signals itself.

    Returns
    -------
    int
        0 after a clean end (also by SIGINT or SIGTERM), 2 after bad parameters or arguments, 3
        after an internal error.
    """
    argv = list(sys.argv if args is None else args)
    try:
        own = remove_ros_args(argv)[1:]
        if own in (["--help"], ["-h"]):
            return run_command(lambda: _explain(help_text, parameters))
        if own:
            raise UserError(f"unknown argument {own[0]!r}; see --help")
        keep_to_this_machine()
        rclpy.init(args=argv, signal_handler_options=signal_handlers)
    # rclpy raises its own private types for a bad command line
    except Exception as error:  # noqa: BLE001
        return _refuse(error)
    node: Node | None = None
    try:
        node = create()
        make_private()
        return _spin(node) if spin is None else spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        return EXIT_DONE
    except (UserError, ParameterException) as error:
        return _refuse(error)
    except Exception as error:  # noqa: BLE001
        return internal_error(error)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _explain(help_text: str, parameters: type) -> int:
    print(f"{help_text.strip()}\n\nParameters (--ros-args -p NAME:=VALUE):")
    print(describe(parameters))
    return EXIT_DONE


def _spin(node: Node) -> int:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except RuntimeError:
        # A signal ends the context also in the middle of a callback: rclpy then cannot publish.
        if node.context.ok():
            raise
    finally:
        # An executor that outlives the context complains when it is collected.
        executor.shutdown()
    return EXIT_DONE


def _refuse(error: Exception) -> int:
    print(f"error: {_first_line(error)}", file=sys.stderr)
    return EXIT_BAD_INPUT


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
