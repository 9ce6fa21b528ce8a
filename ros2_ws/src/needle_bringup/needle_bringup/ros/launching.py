"""Common part of the launch files; the only module that imports `launch`, which PyPI lacks."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription
from needle_bringup.simulation.launch_nodes import LAUNCHED_PACKAGES, refuse_misspelt
from needle_bringup.simulation.node_graph import RECORDER_GRACE
from needle_core.settings.parameter_files import Parameters


def describe(
    arguments: Mapping[str, tuple[str, str]],
    nodes: Callable[[Mapping[str, str]], Parameters],
    choices: Mapping[str, Sequence[str]] = {},
    words: Callable[[Mapping[str, str]], Mapping[str, Sequence[str]]] = lambda _: {},
) -> LaunchDescription:
    """Return a launch description that ends as soon as one of its nodes does.

    Parameters
    ----------
    arguments : mapping
        Launch arguments in addition to `namespace`, with default and description. A misspelt
        argument ends the launch.
    nodes : callable
        Receives the launch arguments, and returns the parameters by node; an exception ends the
        launch before a node is started.
    choices : mapping
        Allowed values by argument.
    words : callable
        Receives the launch arguments, and returns further command line arguments by node.
    """
    every = {**arguments, "namespace": ("", "namespace of all nodes")}

    def start(context: Any) -> list[Node]:
        refuse_misspelt(context.launch_configurations, list(every))
        given = {name: LaunchConfiguration(name).perform(context) for name in every}
        more = words(given)
        return [
            _node(name, values, given["namespace"], more.get(name, ()))
            for name, values in nodes(given).items()
        ]

    declared = [
        DeclareLaunchArgument(
            name, default_value=default, description=text, choices=choices.get(name)
        )
        for name, (default, text) in every.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def _node(name: str, values: Mapping[str, Any], namespace: str, words: Sequence[str]) -> Node:
    ros_arguments = []
    for parameter, value in values.items():
        ros_arguments += ["-p", f"{parameter}:={json.dumps(value)}"]
    # A slow disk delays the end of the recorder.
    grace = {"sigterm_timeout": str(RECORDER_GRACE)} if name == "recorder" else {}
    return Node(
        package=LAUNCHED_PACKAGES[name],
        executable=name,
        namespace=namespace,
        arguments=list(words),
        ros_arguments=ros_arguments,
        output="screen",
        on_exit=Shutdown(reason=f"{name} has ended"),
        **grace,
    )
