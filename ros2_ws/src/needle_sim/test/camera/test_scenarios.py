"""Disturbances of the scenarios: repeatable, at the right place, without side effects."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from needle_sim.camera.clutter import OcclusionEvent
from needle_sim.camera.optics import Optics, project
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import (
    SCENARIOS,
    Bubbles,
    Lens,
)
from needle_sim.camera.stereo_rig import (
    SimulatedCamera,
    SimulatedWindow,
    StereoRig,
    load_stereo_rig,
)

from .scenes import STILL, TOP_AND_SIDE, needle, render, small, taken


def troubled(rig: StereoRig, **troubles: Any) -> StereoRenderer:
    return StereoRenderer(rig, 5, scenario=dataclasses.replace(STILL, **troubles))


def cameras(rig: StereoRig) -> tuple[SimulatedCamera, SimulatedCamera]:
    return rig.left, rig.right


@pytest.fixture(scope="module", params=SCENARIOS)
def renderers(rig: StereoRig, request: pytest.FixtureRequest) -> list[StereoRenderer]:
    """Return the renderers of a scenario with seeds 5, 5 and 6."""
    scenario = SCENARIOS[request.param]
    return [StereoRenderer(small(rig), seed, scenario=scenario) for seed in (5, 5, 6)]


def test_a_scenario_repeats_regardless_of_earlier_renderings(
    renderers: list[StereoRenderer],
) -> None:
    plant, (one, two, other) = needle(0.08), renderers
    late, early = (render(one, plant, number) for number in (31, 3))
    np.testing.assert_array_equal(early, render(two, plant, 3))
    assert np.any(render(other, plant, 3)[0] != early[0])
    assert np.any(late[0] != early[0])


@pytest.mark.parametrize("name", ["heavy_clutter", "steel"])
def test_a_scenario_is_drawn_through_windows_too(name: str) -> None:
    rig = small(load_stereo_rig(TOP_AND_SIDE))
    renderer = StereoRenderer(rig, 5, scenario=SCENARIOS[name])
    dark = taken(render(renderer, needle(0.08), 3), render(renderer, None, 3))
    assert np.all(np.abs(dark).max(axis=(1, 2)) > 20.0)
    if renderer.bubbles is not None:
        for camera in cameras(rig):
            heights = camera.window.height(renderer.bubbles.centre)
            assert np.all(heights + renderer.bubbles.radius < camera.window.inner)


def test_bubbles_are_seen_where_refraction_puts_them(rig: StereoRig) -> None:
    renderer = troubled(rig, bubbles=Bubbles(14, 0.001, 0.0015))
    assert renderer.bubbles is not None
    dark = taken(render(renderer, None, 0), render(troubled(rig), None, 0))
    checked = 0
    for image, camera in zip(dark, cameras(rig), strict=True):
        centres = project(renderer.bubbles.centre, camera)
        dry = SimulatedWindow(camera.window.normal, camera.window.outer, (), (1.0,))
        straight = project(renderer.bubbles.centre, dataclasses.replace(camera, window=dry))
        for i, (u, v) in enumerate(centres):
            apart = np.linalg.norm(np.delete(centres, i, axis=0) - [u, v], axis=1)
            if not (40 < u < 980 and 40 < v < 720) or apart.min() < 45.0:
                continue
            top, left = int(v) - 20, int(u) - 20
            rows, columns = np.nonzero(image[top : top + 41, left : left + 41] > 15.0)
            middle = [left + (columns.min() + columns.max()) / 2.0]
            middle += [top + (rows.min() + rows.max()) / 2.0]
            np.testing.assert_allclose(middle, [u, v], atol=0.8)
            if 0.0175 - renderer.bubbles.centre[i, 0] > 0.02:
                assert np.linalg.norm(middle - straight[i]) > 2.0
            checked += 1
    assert checked >= 10


def test_blur_is_that_of_a_thin_lens(rig: StereoRig) -> None:
    lens = Lens(focus_height=0.065, aperture=0.011)
    points = np.zeros((4, 3))
    points[:, 0] = [0.065, 0.0175, 0.0, -0.0175]
    blur = np.asarray(Optics(rig.left, lens).blur_px(points))
    assert blur[0] == pytest.approx(0.7, abs=1e-6)
    assert np.all(np.diff(blur) > 0.0)
    # At the surface, 500 mm away, focused at 452.5 mm; image distances by 1/f = 1/a + 1/b.
    image_at = [1.0 / (1.0 / 16e-3 - 1.0 / distance) for distance in (0.4525, 0.5)]
    disk = lens.aperture * (image_at[0] - image_at[1]) / image_at[1]
    pixel = image_at[0] / rig.left.camera_matrix[0, 0]
    assert np.sqrt(blur[1] ** 2 - 0.49) == pytest.approx(disk / pixel / 4.0, rel=0.01)


@pytest.mark.parametrize("length", [0.02, 0.12])
def test_an_occlusion_blocks_its_cameras(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch, length: float
) -> None:
    rig = small(rig)
    renderer = troubled(rig, occlusion=True)
    plant = needle(length, 3.0, 17.0, curvature=2.0)
    pose, line = plant.T_rig_tip, plant.centreline(0.001)
    for blocks, covered in itertools.product(
        ((True, False), (False, True), (True, True)), (False, True)
    ):
        event = OcclusionEvent(blocks, covered, 0.5)
        monkeypatch.setattr("needle_sim.camera.renderer.occlusion_at", lambda *_, e=event: e)
        seen = tuple(float(not blocked) for blocked in blocks)
        assert renderer.visible_share(pose, line, 0) == seen
        empty = renderer.render(pose, np.zeros((1, 3)), 0)
        dark = taken(renderer.render(pose, line, 0), empty)
        for image, camera, blocked in zip(dark, cameras(rig), blocks, strict=True):
            u, v = np.rint(project(pose[:3, 3], camera)).astype(int)
            near = np.abs(image[v - 5 : v + 6, u - 10 : u + 2])
            assert near.max() <= 1.0 if blocked else near.max() > 30.0
