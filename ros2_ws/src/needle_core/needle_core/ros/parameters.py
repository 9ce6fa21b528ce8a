"""Declaration of a parameter dataclass on a node, and checks of changes while it runs."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rcl_interfaces.msg import SetParametersResult as Result
from rclpy.node import Node
from rclpy.parameter import Parameter

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import ParameterSpec, from_values, specs
from needle_core.settings.parameter_files import check_command_line

P = TypeVar("P")

_SIM_TIME = "use_sim_time"
COMMON_PARAMETERS = (_SIM_TIME, "start_type_description_service", "qos_overrides.")
"""Prefixes of the parameters that every rclpy node declares itself."""


class NodeParameters(Generic[P]):
    """Declared parameters of a node; changes to invalid combinations are rejected.

    Parameters
    ----------
    node : Node
        Node to declare them on.
    parameters : type
        Frozen dataclass whose fields come from `parameter_fields.parameter`.
    on_change : callable, optional
        Called with the new instance after a change.

    Raises
    ------
    UserError
        If a given parameter is unknown, of the wrong type, out of bounds, or meant for the node
        but without effect.
    """

    def __init__(
        self, node: Node, parameters: type[P], on_change: Callable[[P], None] | None = None
    ) -> None:
        self._on_change = on_change
        for line in check_command_line(sys.argv, node.get_fully_qualified_name()):
            node.get_logger().warning(line)
        # Checked here, because rclpy silently drops undeclared overrides: a misspelt gain would
        # have no effect. The value of an empty list is None.
        given = {
            name: _plain(override.value)
            for name, override in node._parameter_overrides.items()
            if override.value is not None and not name.startswith(COMMON_PARAMETERS)
        }
        self.values = from_values(parameters, given, node.get_fully_qualified_name())
        for name, spec, default in specs(parameters):
            value = list(default) if isinstance(default, tuple) else default
            # ROS cannot infer the type of an empty list; lists of strings are dynamically typed.
            empty = value == [] and not spec.texts
            if empty:
                value = Parameter.Type.DOUBLE_ARRAY
            declared = node.declare_parameter(name, value, _descriptor(spec, default))
            if empty and declared.value is None:
                node.set_parameters([Parameter(name, Parameter.Type.DOUBLE_ARRAY, [])])
        self._sim_time = bool(node.get_parameter(_SIM_TIME).value)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _changed(self, changes: list[Parameter]) -> P:
        own = {field.name for field in dataclasses.fields(self.values)}  # type: ignore[arg-type]
        update = {p.name: _plain(p.value) for p in changes if p.name in own}
        return dataclasses.replace(self.values, **update)  # type: ignore[type-var]

    def _check(self, changes: list[Parameter]) -> Result:
        for change in changes:
            if change.name == _SIM_TIME and change.value is not self._sim_time:
                return Result(successful=False, reason=f"{_SIM_TIME} is fixed at start")
        try:
            self._changed(changes)
        except UserError as error:
            return Result(successful=False, reason=str(error))
        return Result(successful=True)

    def _apply(self, changes: list[Parameter]) -> None:
        changed = self._changed(changes)
        if changed != self.values:
            self.values = changed
            if self._on_change is not None:
                self._on_change(changed)


def _plain(value: Any) -> Any:
    """Return lists and arrays as tuples, other values unchanged."""
    return value if isinstance(value, (str, int, float, bool)) else tuple(value)


def _descriptor(spec: ParameterSpec, default: Any) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=spec.description,
        additional_constraints=f"unit: {spec.unit}"
        + (f"; one of {', '.join(spec.choices)}" if spec.choices else ""),
        read_only=spec.read_only,
        dynamic_typing=spec.texts,
    )
    bounded = math.isfinite(spec.lower) and math.isfinite(spec.upper)
    if isinstance(default, bool) or not bounded:
        return descriptor
    if isinstance(default, int):
        descriptor.integer_range = [
            IntegerRange(from_value=int(spec.lower), to_value=int(spec.upper), step=0)
        ]
    elif isinstance(default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(spec.lower), to_value=float(spec.upper), step=0.0)
        ]
    return descriptor
