"""What a person reads who gave a parameter of the wrong kind."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import pytest
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from needle_core.errors import UserError
from needle_core.ros.parameters import NodeParameters
from needle_core.settings.parameter_fields import check_fields, parameter


@dataclasses.dataclass(frozen=True)
class Settings:
    """One of each kind."""

    rate: float = parameter(30.0, unit="Hz", lower=1.0, upper=100.0, description="A rate.")
    count: int = parameter(3, unit="-", lower=1, upper=9, description="A count.")

    def __post_init__(self) -> None:
        check_fields(self)


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    context.init()
    yield context
    context.try_shutdown()


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("rate", 50, "rate = 50 is not of type float (write 50.0)"),
        ("rate", "fast", "rate = 'fast' is not of type float"),
        ("rate", True, "rate = True is not of type float"),
        ("count", 2.0, "count = 2.0 is not of type int"),
        ("rate", 200.0, "rate = 200.0 is outside [1, 100] Hz"),
        ("raet", 20.0, "unknown parameter 'raet' (did you mean 'rate'?)"),
    ],
)
def test_a_bad_value_is_named(context: Context, name: str, value: object, text: str) -> None:
    node = Node("rig", context=context, parameter_overrides=[Parameter(name, value=value)])
    with pytest.raises(UserError) as caught:
        NodeParameters(node, Settings)
    node.destroy_node()
    assert str(caught.value) == f"/rig: {text}"
