"""Node parameters as frozen dataclasses: one declaration gives default, unit, range and text."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, cast

from needle_common.errors import UserError
from needle_common.settings.bounds import check_bounds

_METADATA_KEY = "needle_parameter"


@dataclasses.dataclass(frozen=True)
class ParameterSpec:
    """Description of a parameter, beside its value.

    Attributes
    ----------
    unit : str
        SI unit, "-" for none.
    description : str
        One sentence for `--help` and `ros2 param describe`.
    lower, upper : float
        Inclusive bounds of a number, or of each element of a list.
    choices : tuple of str
        The allowed texts; empty: any text.
    read_only : bool
        Whether the value is fixed once the node runs.
    texts : bool
        Whether the elements of a list are texts; numbers otherwise.
    """

    unit: str
    description: str
    lower: float = -math.inf
    upper: float = math.inf
    choices: tuple[str, ...] = ()
    read_only: bool = False
    texts: bool = False


def parameter(default: Any, **spec: Any) -> Any:
    """Declare a field of a parameter dataclass; the keywords are those of `ParameterSpec`."""
    return dataclasses.field(default=default, metadata={_METADATA_KEY: ParameterSpec(**spec)})


def fixed_parameter(default: Any, *spec: Any, **more: Any) -> Any:
    """Declare a field whose value is fixed once the node runs, by the arguments of the spec."""
    fixed = dataclasses.replace(ParameterSpec(*spec, **more), read_only=True)
    return dataclasses.field(default=default, metadata={_METADATA_KEY: fixed})


def specs(parameters: Any) -> Iterator[tuple[str, ParameterSpec, Any]]:
    """Yield (name, spec, default) of each parameter of a parameter dataclass or instance."""
    for field in dataclasses.fields(parameters):
        yield field.name, cast(ParameterSpec, field.metadata[_METADATA_KEY]), field.default


def check_fields(parameters: Any) -> None:
    """Check every field of a parameter dataclass; call it first in `__post_init__`.

    Raises
    ------
    OutOfBoundsError
        A number that is outside its bounds.
    UserError
        A number that is not finite, a text that is not one of the choices, or another type than
        the default's.
    """
    for name, spec, default in specs(parameters):
        value = getattr(parameters, name)
        if type(value) is not type(default):
            raise UserError(
                f"{name} = {value!r} is of type {type(value).__name__}, "
                f"wants {type(default).__name__}"
            )
        for element in value if isinstance(value, tuple) else (value,):
            if isinstance(element, (int, float)) and not isinstance(element, bool):
                check_bounds(name, element, spec.lower, spec.upper, spec.unit)
            elif spec.choices and element not in spec.choices:
                raise UserError(f"{name} = {element!r} is not one of {', '.join(spec.choices)}")


def describe(parameters: type) -> str:
    """Return the parameter table of a dataclass as `--help` shows it, one parameter a line."""
    lines = []
    for name, spec, default in specs(parameters):
        shown = list(default) if isinstance(default, tuple) else default
        unit = "" if spec.unit == "-" else f" {spec.unit}"
        bounds = ""
        if math.isfinite(spec.lower) or math.isfinite(spec.upper):
            bounds = f" [{spec.lower:g}, {spec.upper:g}]"
        elif spec.choices:
            bounds = f" [{', '.join(spec.choices)}]"
        fixed = " (fixed at start)" if spec.read_only else ""
        lines.append(f"  {name}: {shown!r}{unit}{bounds}{fixed}\n      {spec.description}")
    return "\n".join(lines)
