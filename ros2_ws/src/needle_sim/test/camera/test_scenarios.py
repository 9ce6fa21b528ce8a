"""Disturbances of the scenarios: repeatable, at the right place, without side effects."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from scipy.optimize import fsolve

from needle_sim.camera.clutter import OcclusionEvent, occlusion_at
from needle_sim.camera.optics import Optics, project
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import (
    SCENARIOS,
    Bubbles,
    FloorShadow,
    Lens,
)
from needle_sim.camera.stereo_rig import (
    SimulatedCamera,
    SimulatedWindow,
    StereoRig,
    load_stereo_rig,
)
from needle_sim.needle.needle_shape import NeedleShape

from .scenes import STILL, TOP_AND_SIDE, needle, render, small, taken


def troubled(rig: StereoRig, **troubles: Any) -> StereoRenderer:
    return StereoRenderer(rig, 5, scenario=dataclasses.replace(STILL, **troubles))


def cameras(rig: StereoRig) -> tuple[SimulatedCamera, SimulatedCamera]:
    return rig.left, rig.right


def place_at(height: float, pixel: np.ndarray, camera: SimulatedCamera) -> np.ndarray:
    """Return the place at a height [m] that a camera sees at a pixel."""

    def miss(yz: np.ndarray) -> np.ndarray:
        return np.asarray(project([height, *yz], camera) - pixel)

    return np.array([height, *fsolve(miss, [0.0, 0.05])])


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


def test_the_shadow_lies_on_the_floor(rig: StereoRig) -> None:
    # Seed 3's light throws the shadow clear of the needle in both views.
    straight, plant = NeedleShape(bend_angle=2e-9, lean=1e-9), needle(0.09, curvature=0.0)
    shadowed, plain = (
        StereoRenderer(rig, 3, straight, dataclasses.replace(STILL, shadow=shadow))
        for shadow in (FloorShadow(floor_depth=0.030), None)
    )
    dark = taken(render(shadowed, plant, 0), render(plain, plant, 0))
    assert dark.max() > 20.0

    def middles(image: np.ndarray, columns: np.ndarray) -> np.ndarray:
        rows = image[:, columns].argmax(axis=0)[:, np.newaxis] + np.arange(-14, 15)
        part = np.clip(image[rows, columns[:, np.newaxis]], 0.0, None)
        return np.asarray((part * rows).sum(axis=1) / part.sum(axis=1))

    columns, across = np.arange(320, 560, 40), np.arange(250, 650)
    left, right = middles(dark[0], columns), middles(dark[1], across)

    def right_rows(depth: float) -> np.ndarray:
        """Return the offset of the right shadow from the left one projected at a depth [px]."""
        seen = (np.array([float(u), v]) for u, v in zip(columns, left, strict=True))
        places = [project(place_at(0.0175 - depth, pixel, rig.left), rig.right) for pixel in seen]
        return np.array([v - np.interp(u, across, right) for u, v in places])

    assert np.abs(right_rows(0.030)).max() < 0.3
    assert np.abs(right_rows(0.027)).min() > 3.0


def test_blur_is_that_of_a_thin_lens_and_keeps_the_darkness_of_the_needle(rig: StereoRig) -> None:
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
    profiles = []
    for each in (None, lens):
        renderer = troubled(rig, lens=each)
        dark = taken(render(renderer, needle(0.09, curvature=0.0), 0), render(renderer, None, 0))
        row = int(dark[0][:, 400].argmax())
        profiles.append(dark[0][row - 25 : row + 26, 380:420].mean(axis=1))
    assert profiles[1].sum() == pytest.approx(profiles[0].sum(), rel=0.05)
    assert profiles[1].max() < 0.7 * profiles[0].max()


def test_events_of_every_kind_occur_in_every_interval() -> None:
    events = [occlusion_at(3, number) for number in range(20 + 40 * 30)]
    assert all(event is None for event in events[:20])
    kinds = set()
    for stretch in range(30):
        part = [e for e in events[20 + 40 * stretch : 60 + 40 * stretch] if e is not None]
        assert len({(e.blocks, e.covered) for e in part}) == 1
        assert len(part) == (6 if all(part[0].blocks) else 14)
        assert np.all(np.diff([e.progress for e in part]) > 0.0)
        kinds.add((part[0].blocks, part[0].covered))
    assert len(kinds) == 6


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
