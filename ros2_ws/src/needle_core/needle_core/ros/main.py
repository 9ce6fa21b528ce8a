"""Main loop of the node executables: runs a node or a component until a signal ends it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import rclpy
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
from needle_core.component import Component, RealPort
from needle_core.errors import UserError
from needle_core.process.discovery import restrict_discovery
from needle_core.process.shared_memory import remove_incomplete_ports
from needle_core.process.shutdown import ShutdownFlag
from needle_core.ros.component_node import ComponentNode
from needle_core.settings.parameter_fields import describe
from needle_core.settings.parameter_files import command_line_sections

_ROS_OPTIONS = ("-p", "--param", "--params-file", "-r", "--remap", "--log-level")
# A blocked executor does not notice signals, so it wakes up with this period [s].
_WAKE_UP_PERIOD = 0.1
# Time to wait at exit for acknowledgements of the last messages [s]: if the node ends by itself
# (a recorder that was suspended for 4 s acknowledged within 3 s), and after a signal.
_ACKNOWLEDGED_WITHIN, _ACKNOWLEDGED_AFTER_SIGNAL = 5.0, 0.5


def run_node(
    create: Callable[[], Node],
    *,
    help_text: str,
    parameters: type,
    args: list[str] | None = None,
    spin: Callable[[Node, ShutdownFlag], int] | None = None,
    shared_memory: bool = True,
) -> int:
    """Run a node until a signal ends it, or print its help if the command line has `--help`.

    Parameters
    ----------
    create : callable
        Returns the node; called after rclpy is initialized.
    help_text : str
        Purpose, topics and services of the node: the first part of `--help`.
    parameters : type
        Parameter dataclass of the node: the second part of `--help`.
    args : list of str, optional
        Command line with the program's name; sys.argv by default.
    spin : callable, optional
        Runs the node until the shutdown flag is set and returns the exit code; by default it
        only spins.
    shared_memory : bool
        Whether messages may use shared memory, as images must: see `restrict_discovery`.

    Returns
    -------
    int
        0 after a clean end (also by SIGINT, SIGTERM or SIGHUP), 2 after bad parameters or
        arguments, 3 after an internal error.
    """
    argv = list(sys.argv if args is None else args)
    with ShutdownFlag() as end:
        try:
            # rclpy reads the files as well, but its errors do not explain the problem.
            command_line_sections(argv)
            own = remove_ros_args(argv)[1:]
            if own in (["--help"], ["-h"]):
                return run_command(lambda: _explain(help_text, parameters))
            # rcl would accept NAME:=VALUE as a remapping and set no parameter.
            before = argv[1 : argv.index("--ros-args")] if "--ros-args" in argv else argv[1:]
            own = own or [argument for argument in before if ":=" in argument]
            if own:
                raise UserError(f"unknown argument {own[0]!r}; {_hint(own[0])}")
            restrict_discovery(shared_memory=shared_memory)
            remove_incomplete_ports()
            # rclpy's own handlers would shut the context down in the middle of a callback.
            rclpy.init(args=argv, signal_handler_options=SignalHandlerOptions.NO)
        # rclpy raises private exception types for a bad command line.
        except Exception as error:  # noqa: BLE001
            return _reject(error)
        return _run(create, spin or _spin, end)


def run_component(
    name: str,
    parameters: type[Any],
    make: Callable[[Any, str], Component],
    *,
    help_text: str,
    ports: Callable[[Any], Mapping[str, RealPort]] = lambda _: {},
    interrupted: int = EXIT_DONE,
    shared_memory: bool = True,
) -> int:
    """Run a component as a node until it or a signal ends it; see `run_node`.

    Parameters
    ----------
    name : str
        Name of the node.
    parameters : type
        Settings dataclass of the component: the parameters of the node.
    make : callable
        Returns the component, given its settings and the node's full name.
    help_text, shared_memory
        As for `run_node`.
    ports : callable
        Returns the component's real ports, given its settings.
    interrupted : int
        Exit code if a signal ended unfinished work.

    Returns
    -------
    int
        The component's exit code; 2 after bad parameters, 3 after an internal error.
    """
    return run_node(
        lambda: ComponentNode(name, parameters, make, ports),
        help_text=help_text,
        parameters=parameters,
        spin=partial(_spin_component, interrupted),
        shared_memory=shared_memory,
    )


def _hint(argument: str) -> str:
    if ":=" in argument:
        return f"set a parameter with --ros-args -p {argument}"
    return "put it after --ros-args" if argument in _ROS_OPTIONS else "see --help"


def _run(
    create: Callable[[], Node], spin: Callable[[Node, ShutdownFlag], int], end: ShutdownFlag
) -> int:
    node: Node | None = None
    code = EXIT_INTERNAL_ERROR
    try:
        node = create()
        code = spin(node, end)
    except (UserError, ParameterException) as error:
        code = _reject(error)
        if end.requested:
            # The signal also ends other nodes, so their absence is not bad input.
            code = EXIT_DONE
    except Exception as error:  # noqa: BLE001
        # If rclpy cannot create the node, its name or namespace is invalid.
        is_bad_input = node is None and isinstance(error, rclpy_implementation.RCLError)
        code = _reject(error) if is_bad_input else internal_error(error)
    finally:
        if node is not None and node.context.ok():
            _wait_for_acknowledgements(
                node, _ACKNOWLEDGED_AFTER_SIGNAL if end.requested else _ACKNOWLEDGED_WITHIN
            )
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


def _wait_for_acknowledgements(node: Node, seconds: float) -> None:
    """Wait until all reliable subscribers have received the node's messages.

    Without this wait, a busy recorder could silently miss the end of a run.
    """
    until = time.monotonic() + seconds
    for publisher in node.publishers:
        left = max(until - time.monotonic(), 0.0)
        publisher.wait_for_all_acked(Duration(seconds=left))


def _explain(help_text: str, parameters: type) -> int:
    print(f"{help_text.strip()}\n\nParameters (--ros-args -p NAME:=VALUE):")
    print(describe(parameters))
    return EXIT_DONE


def _spin(node: Node, end: ShutdownFlag) -> int:
    _spin_until(node, lambda: end.requested)
    return EXIT_DONE


def _spin_component(interrupted: int, node: Node, end: ShutdownFlag) -> int:
    assert isinstance(node, ComponentNode)
    is_stopping = False

    def is_done() -> bool:
        nonlocal is_stopping
        if end.requested and not is_stopping:
            is_stopping = True
            node.stop()
        return node.exit is not None

    try:
        _spin_until(node, is_done)
    finally:
        node.close()
    assert node.exit is not None
    if node.exit.text:
        print(f"{node.get_name()}: {node.exit.text}", file=sys.stderr)
    # The signal also ends other nodes, so a failure due to their absence counts as interrupted.
    return interrupted if end.requested and node.exit.code else node.exit.code


def _spin_until(node: Node, is_done: Callable[[], bool]) -> None:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        while not is_done():
            executor.spin_once(timeout_sec=_WAKE_UP_PERIOD)
    finally:
        # An executor that outlives the context raises an error when it is garbage-collected.
        executor.shutdown()


def _reject(error: Exception) -> int:
    lines = str(error).strip().splitlines()
    print(f"error: {lines[0] if lines else type(error).__name__}", file=sys.stderr)
    return EXIT_BAD_INPUT
