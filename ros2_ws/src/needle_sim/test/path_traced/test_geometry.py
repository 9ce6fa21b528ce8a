"""Geometry: rays compared with the quick renderer's projection, and the needle mesh."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from needle_sim.camera.optics import project
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig, load_stereo_rig
from needle_sim.path_traced import insertion
from needle_sim.path_traced.appearance import RANDOM, draw_appearance
from needle_sim.path_traced.needle_mesh import needle_mesh
from needle_sim.path_traced.path_tracing import refracted_rays
from needle_sim.sequences.boxes import draw_box

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"
RIG = load_stereo_rig(CALIBRATION)
TOP_AND_SIDE = load_stereo_rig(CALIBRATION.with_name("calibration_top_and_side.yaml"))


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> list[StereoRig]:
    """Return random boxes in front of webcams."""
    path = tmp_path_factory.mktemp("boxes") / "box.yaml"
    rigs = []
    for seed in range(8):
        path.write_text(draw_box(seed), encoding="utf-8")
        rigs.append(load_stereo_rig(path))
    return rigs


def cameras(rigs: list[StereoRig]) -> Iterator[tuple[StereoRig, SimulatedCamera]]:
    for rig in rigs:
        yield from ((rig, rig.left), (rig, rig.right))


def bent_line() -> tuple[np.ndarray, np.ndarray]:
    """Return a centre line of curvature 8 / m in an oblique plane, and the side it bends to."""
    aside = np.array([0.6, 0.8, 0.0])
    angle = np.linspace(0.0, 0.4, 201)[:, np.newaxis]
    line = 0.125 * (np.sin(angle) * [0.0, 0.0, 1.0] + (1.0 - np.cos(angle)) * aside)
    return line, aside


def test_the_ray_of_a_pixel_meets_the_point_projected_there(boxes: list[StereoRig]) -> None:
    for rig, camera in cameras([RIG, TOP_AND_SIDE, *boxes]):
        columns = np.linspace(0.0, camera.image_width - 1.0, 9)
        lines = np.linspace(0.0, camera.image_height - 1.0, 7)
        pixels = np.stack(np.meshgrid(columns, lines), axis=-1)
        rays = refracted_rays(pixels, camera, rig)
        np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=-1), 1.0, atol=1e-12)
        inside = ~rays.in_air
        assert inside.mean() > 0.2
        for way in (0.0001, 0.05):
            points = (rays.origin + way * rays.direction)[inside]
            np.testing.assert_allclose(project(points, camera), pixels[inside], atol=1e-6)


@pytest.mark.parametrize("hollow", [False, True])
def test_the_mesh_has_its_diameter_and_its_end(hollow: bool) -> None:
    line, aside = bent_line()
    look = dataclasses.replace(
        draw_appearance(RANDOM, 3), diameter=0.0007, bevel_angle=np.pi / 6.0, hollow=hollow
    )
    needle = needle_mesh(line, aside, look)
    heading = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    assert look.bevel_length == pytest.approx(0.0012124, abs=1e-7)
    # Next to the end of the axis, on the side of the bend, and level with it.
    away = needle.extreme - line[-1]
    assert np.linalg.norm(away) == pytest.approx(0.00035, abs=1e-8)
    assert abs(away @ heading) < 1e-6
    assert away @ aside > 0.0003
    shaft, face = needle.parts["shaft"], needle.parts["face"]
    assert ((shaft.points - needle.extreme) @ heading).max() < 1e-6
    # The axis goes through the ground face half its length behind.
    assert (line[-1] - needle.face_middle) @ heading == pytest.approx(0.0006062, abs=1e-6)
    normal = face.normals[0]
    assert normal @ heading == pytest.approx(np.sin(np.deg2rad(30.0)), abs=0.005)
    assert np.abs((face.points - needle.extreme) @ normal).max() < 5e-6
    assert set(needle.parts) == {"shaft", "face"} | ({"bore"} if hollow else set())
    from_axis = np.linalg.norm(shaft.points[::5, np.newaxis] - line[::4], axis=-1).min(axis=1)
    assert from_axis.min() > 0.000349
    np.testing.assert_allclose(np.linalg.norm(shaft.normals, axis=1), 1.0, atol=1e-12)
    corners = shaft.points[shaft.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", outward, shaft.normals[shaft.faces[:, 0]]) > -1e-14).all()


def test_an_insertion_is_the_empty_phantom_then_a_needle_that_stops_at_its_depth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Blank:
        def __init__(self, *_: object) -> None:
            pass

        def render(self, *_: object) -> tuple[np.ndarray, np.ndarray]:
            return np.zeros((3, 4), np.uint8), np.zeros((3, 4), np.uint8)

    monkeypatch.setattr(insertion, "PathTracedRenderer", Blank)
    look = dataclasses.replace(draw_appearance("oxide_on_grey", 3), lag=0.0)
    way: dict[str, Any] = {"frames": 4, "depth": 0.05, "step": 0.02, "begin": 0.01}
    pairs = list(insertion.trace_insertion(None, RIG, look, **way, empty_first=True))  # type: ignore[arg-type]
    assert [pair.number for pair in pairs] == [0, 1, 2, 3, 4]
    assert (pairs[0].truth, pairs[0].meshes, pairs[0].visible_share) == (None, None, (0.0, 0.0))
    assert [pair.insertion for pair in pairs] == pytest.approx([0.0, 0.01, 0.03, 0.05, 0.05])
    for pair in pairs[1:]:
        assert pair.truth is not None
        assert pair.meshes is not None
        inside = pair.meshes[0].line[pair.meshes[0].line[:, 2] > 0.0]
        length = np.linalg.norm(np.diff(inside, axis=0), axis=1).sum()
        assert length == pytest.approx(pair.insertion, abs=1e-3)
