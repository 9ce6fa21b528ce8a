"""Node parameters as frozen dataclasses; a field declares default, unit, range and description."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar, cast

from needle_core.errors import UserError, did_you_mean
from needle_core.settings.bounds import check_bounds

P = TypeVar("P")
_METADATA_KEY = "needle_parameter"


@dataclasses.dataclass(frozen=True)
class ParameterSpec:
    """Description of a parameter.

    Attributes
    ----------
    unit : str
        SI unit, "-" for none.
    description : str
        One sentence for `--help` and `ros2 param describe`.
    lower, upper : float
        Inclusive bounds of a number, or of each element of a list.
    choices : tuple of str
        Allowed strings; if empty, any string is allowed.
    read_only : bool
        Whether the value cannot change after the start.
    texts : bool
        Whether the elements of a list are strings; otherwise they are numbers.
    """

    unit: str
    description: str
    lower: float = -math.inf
    upper: float = math.inf
    choices: tuple[str, ...] = ()
    read_only: bool = False
    texts: bool = False


def parameter(default: Any, *spec: Any, **more: Any) -> Any:
    """Declare a field of a parameter dataclass; the arguments are those of `ParameterSpec`."""
    return dataclasses.field(
        default=default, metadata={_METADATA_KEY: ParameterSpec(*spec, **more)}
    )


def fixed_parameter(default: Any, *spec: Any, **more: Any) -> Any:
    """Declare a field whose value cannot change after the start; see `parameter`."""
    return parameter(default, *spec, **more, read_only=True)


def specs(parameters: Any) -> Iterator[tuple[str, ParameterSpec, Any]]:
    """Yield (name, spec, default) of each parameter of a parameter dataclass or instance."""
    for field in dataclasses.fields(parameters):
        yield field.name, cast(ParameterSpec, field.metadata[_METADATA_KEY]), field.default


def check_fields(parameters: Any) -> None:
    """Check every field of a parameter dataclass; call it first in `__post_init__`.

    Raises
    ------
    OutOfBoundsError
        If a number is outside its bounds.
    UserError
        If a number is not finite, a string is not one of the choices, or a type differs from the
        default's.
    """
    for name, spec, default in specs(parameters):
        value = getattr(parameters, name)
        if type(value) is not type(default):
            raise UserError(
                f"{name} = {value!r} is of type {type(value).__name__}, "
                f"expected {type(default).__name__}"
            )
        for element in value if isinstance(value, tuple) else (value,):
            if isinstance(element, (int, float)) and not isinstance(element, bool):
                check_bounds(name, element, spec.lower, spec.upper, spec.unit)
            elif spec.choices and element not in spec.choices:
                raise UserError(f"{name} = {element!r} is not one of {', '.join(spec.choices)}")


def from_values(kind: type[P], values: Mapping[str, Any], node: str) -> P:
    """Return a parameter dataclass from the values of a file or a command line.

    Parameters
    ----------
    kind : type
        The dataclass.
    values : mapping of str to object
        Parameter to value; lists become tuples.
    node : str
        Name of the node, for errors.

    Raises
    ------
    UserError
        If a parameter is unknown, or the dataclass rejects a value.
    """
    known = {name: default for name, _, default in specs(kind)}
    for name, value in values.items():
        if name not in known:
            raise UserError(f"{node}: unknown parameter '{name}' ({did_you_mean(name, known)})")
        if isinstance(known[name], float) and type(value) is int:
            raise UserError(f"{node}: {name} = {value} is not of type float (write {value}.0)")
    plain = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
    try:
        return kind(**plain)
    except UserError as error:
        raise UserError(f"{node}: {error}") from error


def describe(parameters: type) -> str:
    """Return the parameter table of a dataclass for `--help`."""
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
