"""Estimators, laws and planners of other packages, found by their entry points.

A package offers one in its pyproject.toml, and plane_controller, `monte_carlo`, `rerun` and
`simulate` take it by name:

    [project.entry-points."needle_controller.estimators"]
    particle_filter = "particle_filter:ParticleFilter"
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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
"""What can be an own one, and the group of entry points that offers it."""
METHODS: Mapping[str, Mapping[str, str]] = {
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
"""What each must have, and with what it is called; a law may have `to_point`, too."""
MADE_WITH = {
    "estimator": "(settings, initial_rotation, entry, rng)",
    "law": "(settings)",
    "planner": "(settings)",
}
PAGE = "docs/own_controllers.md"


class OwnPartError(UserError):
    """An own estimator, law or planner that is not there, or not what it must be."""


@dataclasses.dataclass(frozen=True)
class OwnPart:
    """An estimator, law or planner of another package.

    Attributes
    ----------
    kind : str
        One of `GROUPS`.
    name : str
        By which it was asked for.
    origin : str
        Package, version and place of the class.
    made_by : type
        The class.
    """

    kind: str
    name: str
    origin: str
    made_by: type[Any]

    def error(self, what: str) -> OwnPartError:
        """Return an error that says whose it is."""
        return OwnPartError(f"{self.kind} {self.name!r} ({self.origin}): {what} ({PAGE})")

    @contextmanager
    def blamed(self, call: str) -> Iterator[None]:
        """Turn whatever the package raises in a call into an `OwnPartError` that names it."""
        try:
            yield
        except OwnPartError:
            raise
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            # The deepest line of the author's own says more than one of a library below.
            file = getattr(sys.modules.get(self.made_by.__module__), "__file__", None)
            frame = [one for one in frames if one.filename == file][-1:] or frames[-1:]
            where = f"{Path(frame[0].filename).name}:{frame[0].lineno}"
            words = " ".join(f"{type(error).__name__}: {error}".split())
            given = METHODS[self.kind].get(call, "")
            raise self.error(f"{call}{given} raised {words} at {where}") from error

    def checked(self, what: str, values: Any, shape: tuple[int, ...], meaning: str) -> Array:
        """Return what it gave as an array.

        Parameters
        ----------
        what : str
            What it is, as the package's author calls it.
        values : array_like
            What was given.
        shape : tuple of int
            What it must have.
        meaning : str
            What is wanted, with units.

        Raises
        ------
        OwnPartError
            Another shape, no numbers, or a number that is not finite.
        """
        try:
            array = np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            given = type(values).__name__
            raise self.error(f"{what} is of type {given}, wants {meaning}") from None
        if array.shape != shape:
            raise self.error(f"{what} has shape {array.shape}, wants {shape}: {meaning}")
        if not np.all(np.isfinite(array)):
            number = next(float(v) for v in array.ravel() if not math.isfinite(v))
            raise self.error(f"{what} holds {number}, wants finite {meaning}")
        return array


def check_is_offered(kind: str, name: str) -> EntryPoint:
    """Return the one entry point that offers an own part; nothing of it is loaded.

    Parameters
    ----------
    kind : str
        One of `GROUPS`.
    name : str
        Its name.

    Raises
    ------
    OwnPartError
        None offers it, or several packages do.
    """
    offered = sorted(entry_points(group=GROUPS[kind]), key=lambda one: one.name)
    # A package that is on the path twice is one.
    found = {(one.value, _package(one)): one for one in offered if one.name == name}
    if not found:
        names = ", ".join(dict.fromkeys(f"{one.name} ({_package(one)})" for one in offered))
        raise OwnPartError(
            f"{kind} = {name!r}: no installed package offers it; offered: {names or 'none'}. One "
            f"is offered by an entry point of group {GROUPS[kind]!r}: {PAGE}"
        )
    if len(found) > 1:
        packages = ", ".join(package for _, package in found)
        raise OwnPartError(f"{kind} = {name!r} is offered by several packages: {packages}")
    return next(iter(found.values()))


def own_part(kind: str, name: str) -> OwnPart:
    """Return an own part, loaded, that has the methods of its kind.

    Parameters, and what is raised, as of `check_is_offered`; also for a module that cannot be
    imported, what is not a class, and a method that is missing.
    """
    entry = check_is_offered(kind, name)
    origin = f"{_package(entry)}, {entry.value}"
    part = OwnPart(kind, name, origin, object)
    with part.blamed("loading it"):
        loaded = entry.load()
    if not inspect.isclass(loaded):
        raise part.error(
            f"{entry.value} is a {type(loaded).__name__}, wants a class that is made with "
            f"{MADE_WITH[kind]}"
        )
    wanted = METHODS[kind]
    missing = [f"{m}{wanted[m]}" for m in wanted if not callable(getattr(loaded, m, None))]
    if missing:
        raise part.error(f"{loaded.__name__} lacks {', '.join(missing)}")
    return OwnPart(kind, name, origin, cast("type[Any]", loaded))


def _package(entry: EntryPoint) -> str:
    dist = entry.dist
    return "no package" if dist is None else f"{dist.name} {dist.version}"
