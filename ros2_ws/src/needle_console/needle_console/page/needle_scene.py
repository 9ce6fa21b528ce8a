"""3D view of the needle with plane, target and uncertainty."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from nicegui import ui

from needle_console.view.drawings import BLUE, GREY, ORANGE
from needle_console.view.snapshot import Array, Snapshot
from needle_console.view.space import (
    ellipsoid,
    plane_centre,
    plane_rotation,
    shaft_points,
    to_view,
)

_LENGTH = 0.12  # length of the drawn plane [m]
_HALF_WIDTH_MM, _MESH_MM = 20.0, 10.0
_SHAFT_MM, _TARGET_MM = 0.6, 1.5
# A smaller ellipsoid would be invisible.
_MIN_RADIUS_MM = 0.8


class NeedleScene:
    """3D view that sends only changes to the browser."""

    def __init__(self) -> None:
        self._pieces: list[tuple[tuple[float, ...], Any]] = []
        self._target: Any = None
        self._cloud: Any = None
        self._sent: dict[str, tuple[float, ...]] = {}
        with ui.element("figure").classes("tile space"):
            self._scene = ui.scene(grid=False, background_color="#b4bdc8", fps=10)
            self._scene.classes("drawing").props(
                'role="img" aria-label="The needle in space with its target and uncertainty"'
            )
            with self._scene as scene:
                # Entry point and axis of the insertion.
                scene.line([0.0, 0.0, 0.0], [_LENGTH * 1e3, 0.0, 0.0]).material(GREY)
                scene.sphere(_SHAFT_MM * 1.5).material("#222222")
            self._scene.move_camera(
                x=50.0, y=-72.0, z=34.0, look_at_x=60.0, look_at_y=0.0, look_at_z=2.0, duration=0
            )

    def show(self, snapshot: Snapshot) -> None:
        """Show a snapshot."""
        self._show_target(snapshot)
        self._show_shaft(shaft_points(snapshot))
        self._show_uncertainty(snapshot)

    def _show_target(self, snapshot: Snapshot) -> None:
        """Show the target point, or the target plane if there is none."""
        point = snapshot.controller.target_point_m if snapshot.controller is not None else None
        centre, rotation = plane_centre(snapshot, _LENGTH), plane_rotation(snapshot)
        placement = [centre, rotation] if point is None else [to_view(np.array(point))]
        if not self._is_new("target", *placement):
            return
        if self._target is not None:
            self._target.delete()
        with self._scene as scene:
            if point is not None:
                self._target = scene.sphere(_TARGET_MM).material(ORANGE)
                self._target.move(*_floats(placement[0]))
            else:
                self._target = _grid(scene).move(*_floats(centre)).rotate_R(rotation.tolist())

    def _show_shaft(self, points: Array) -> None:
        pieces = [(*_floats(a), *_floats(b)) for a, b in pairwise(points)]
        same = 0
        for (sent, _), ends in zip(self._pieces, pieces, strict=False):
            if sent != ends:
                break
            same += 1
        for _, piece in self._pieces[same:]:
            piece.delete()
        del self._pieces[same:]
        with self._scene as scene:
            for ends in pieces[same:]:
                self._pieces.append((ends, _piece(scene, np.array(ends).reshape(2, 3))))

    def _show_uncertainty(self, snapshot: Snapshot) -> None:
        found = ellipsoid(snapshot)
        if found is None:
            return
        centre, half, rotation = found
        if self._is_new("cloud", centre, half, rotation):
            if self._cloud is None:
                with self._scene as scene:
                    self._cloud = scene.sphere(1.0).material(ORANGE, opacity=0.55)
            self._cloud.move(*_floats(centre)).rotate_R(rotation.tolist())
            self._cloud.scale(*_floats(np.maximum(half, _MIN_RADIUS_MM)))

    def _is_new(self, name: str, *arrays: Array) -> bool:
        """Return whether values differ, rounded to 0.01, from those last sent under a name."""
        wanted = tuple(np.round(np.concatenate([a.ravel() for a in arrays]), 2).tolist())
        is_new = self._sent.get(name) != wanted
        self._sent[name] = wanted
        return is_new


def _grid(scene: Any) -> Any:
    """Draw a plane as lines, because a filled one would hide the objects behind it."""
    half, steps = 0.5 * _LENGTH * 1e3, int(_LENGTH * 1e3 / _MESH_MM)
    with scene.group() as grid:
        for x in np.linspace(-half, half, steps + 1):
            ends = [float(x), -_HALF_WIDTH_MM, 0.0], [float(x), _HALF_WIDTH_MM, 0.0]
            scene.line(*ends).material(BLUE)
        for y in np.linspace(
            -_HALF_WIDTH_MM, _HALF_WIDTH_MM, int(2 * _HALF_WIDTH_MM / _MESH_MM) + 1
        ):
            scene.line([-half, float(y), 0.0], [half, float(y), 0.0]).material(BLUE)
    return grid


def _piece(scene: Any, ends: Array) -> Any:
    """Draw a straight piece of the shaft as a cylinder, whose axis is its local y."""
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    y = along / length if length > 0.0 else np.array([0.0, 1.0, 0.0])
    aside = np.eye(3)[int(np.argmin(np.abs(y)))]
    x = np.cross(y, aside)
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, y, np.cross(x, y)])
    piece = scene.cylinder(_SHAFT_MM, _SHAFT_MM, length, radial_segments=6).material("#222222")
    return piece.move(*_floats(ends.mean(axis=0))).rotate_R(rotation.tolist())


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(round(float(value), 2) for value in values)
