"""Estimators, laws and planners of other packages, found by their entry points.

A package declares one in its pyproject.toml, and plane_controller, `monte_carlo`, `rerun` and
`simulate` select it by name:

    [project.entry-points."needle_controller.estimators"]
    particle_filter = "particle_filter:ParticleFilter"
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import sys
import traceback
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, cast

import numpy as np

from needle_controller.model.arrays import Array
from needle_core.errors import UserError

GROUPS = {
    "estimator": "needle_controller.estimators",
    "law": "needle_controller.laws",
    "planner": "needle_controller.planners",
}
"""Kinds of parts, and the group of entry points of each."""
_METHODS: Mapping[str, Mapping[str, str]] = {
    "estimator": {
        "reset": "(tip, joints)",
        "advance": "(d_insertion, d_rotation)",
        "correct": "(tip, covariance, age)",
        "estimate": "()",
        "change_frame": "(T_new_old)",
    },
    "law": {"to_plane": "(estimate, insertion)"},
    "planner": {"via_points": "(tip, target, obstacles)"},
}
"""Required methods and their arguments; a law may also have `to_point`."""
_CONSTRUCTORS = {
    "estimator": "(settings, initial_rotation, entry, rng)",
    "law": "(settings)",
    "planner": "(settings)",
}
_PAGE = "docs/own_controllers.md"


class OwnPartError(UserError):
    """An error of an estimator, law or planner of another package."""


@dataclasses.dataclass(frozen=True)
class OwnPart:
    """An estimator, law or planner of another package.

    Attributes
    ----------
    kind : str
        One of `GROUPS`.
    name : str
        Name of its entry point.
    origin : str
        Package, version and location of the class.
    cls : type
        The class.
    """

    kind: str
    name: str
    origin: str
    cls: type[Any]

    def make(self, *arguments: Any) -> Any:
        """Return an instance."""
        return self.call(f"{self.cls.__name__}{_CONSTRUCTORS[self.kind]}", self.cls, *arguments)

    def error(self, text: str) -> OwnPartError:
        """Return an error that names the part and its origin."""
        return OwnPartError(f"{self.kind} {self.name!r} ({self.origin}): {text} ({_PAGE})")

    def call(self, what: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of the package; its exceptions become an `OwnPartError`.

        Parameters
        ----------
        what : str
            Name of a method, or description of the call.
        function : callable
            The function.
        *arguments : object
            Its arguments.
        """
        try:
            return function(*arguments)
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            # The deepest line of the author's own code is more useful than one of a library.
            file = getattr(sys.modules.get(self.cls.__module__), "__file__", None)
            frame = [one for one in frames if one.filename == file][-1:] or frames[-1:]
            where = f"{Path(frame[0].filename).name}:{frame[0].lineno}"
            words = " ".join(f"{type(error).__name__}: {error}".split())
            described = _METHODS[self.kind].get(what, "")
            raise self.error(f"{what}{described} raised {words} at {where}") from error

    def checked(self, what: str, values: Any, shape: tuple[int, ...], meaning: str) -> Array:
        """Return a result of the part as an array.

        Parameters
        ----------
        what : str
            Name of the result.
        values : array_like
            The result.
        shape : tuple of int
            Required shape.
        meaning : str
            Description with units.

        Raises
        ------
        OwnPartError
            Another shape, values that are not numbers, or a number that is not finite.
        """
        try:
            array = np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            given = type(values).__name__
            raise self.error(f"{what} is of type {given}, expected {meaning}") from None
        if array.shape != shape:
            raise self.error(f"{what} has shape {array.shape}, expected {shape}: {meaning}")
        if not np.all(np.isfinite(array)):
            number = next(float(v) for v in array.ravel() if not math.isfinite(v))
            raise self.error(f"{what} contains {number}, must be finite: {meaning}")
        return array


def check_registered(kind: str, name: str) -> EntryPoint:
    """Return the entry point of a part, without loading it.

    Parameters
    ----------
    kind : str
        One of `GROUPS`.
    name : str
        Name of the entry point.

    Raises
    ------
    OwnPartError
        No package provides it, or several do.
    """
    offered = sorted(entry_points(group=GROUPS[kind]), key=lambda one: one.name)
    # A package may be on the path twice.
    found = {(one.value, _package(one)): one for one in offered if one.name == name}
    if not found:
        names = ", ".join(dict.fromkeys(f"{one.name} ({_package(one)})" for one in offered))
        raise OwnPartError(
            f"{kind} = {name!r}: no installed package provides it; available: {names or 'none'}. "
            f"A package provides one by an entry point of group {GROUPS[kind]!r}: {_PAGE}"
        )
    if len(found) > 1:
        packages = ", ".join(package for _, package in found)
        raise OwnPartError(f"{kind} = {name!r} is provided by several packages: {packages}")
    return next(iter(found.values()))


def own_part(kind: str, name: str) -> OwnPart:
    """Return a loaded part that has the methods of its kind.

    The parameters are those of `check_registered`, whose errors are raised, too.

    Raises
    ------
    OwnPartError
        A module that cannot be imported, an object that is not a class, or a missing method.
    """
    entry = check_registered(kind, name)
    origin = f"{_package(entry)}, {entry.value}"
    part = OwnPart(kind, name, origin, object)
    loaded = part.call("loading it", entry.load)
    if not inspect.isclass(loaded):
        raise part.error(
            f"{entry.value} is a {type(loaded).__name__}, expected a class that is made with "
            f"{_CONSTRUCTORS[kind]}"
        )
    methods = _METHODS[kind]
    missing = [f"{m}{methods[m]}" for m in methods if not callable(getattr(loaded, m, None))]
    if missing:
        raise part.error(f"{loaded.__name__} lacks {', '.join(missing)}")
    return OwnPart(kind, name, origin, cast("type[Any]", loaded))


def _package(entry: EntryPoint) -> str:
    dist = entry.dist
    return "no package" if dist is None else f"{dist.name} {dist.version}"
