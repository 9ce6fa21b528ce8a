"""A bare needle and paper under it: what mirrors the lamp, and where lines lie."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from needle_sim.camera.metal import mirrored, place_lamp
from needle_sim.camera.paper import paper_lines
from needle_sim.camera.projection import project
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import CLEAN, GraphPaper, Metal
from needle_sim.camera.stereo_rig import StereoRig, load_stereo_rig
from needle_sim.needle.plant import NeedlePlant, initial_pose

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"
STILL = dataclasses.replace(CLEAN, noise=0.0)


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return load_stereo_rig(CALIBRATION)


def shaft(angle: float, length: float = 0.1) -> np.ndarray:
    """Return a straight shaft from the entry that is turned in the y-z plane, (M, 3)."""
    ahead = np.array([0.0, np.sin(angle), np.cos(angle)])
    return np.asarray(np.linspace(0.0, length, 200)[:, None] * ahead)


def test_a_shaft_mirrors_where_its_normal_halves_the_angle() -> None:
    camera, lamp = np.array([0.5, 0.0, 0.05]), np.array([0.4, 0.25, 0.05])
    line = shaft(0.0)
    share, place = mirrored(line, camera, lamp, Metal())
    # Abreast of both, and nowhere else as much.
    assert line[np.argmax(share), 2] == pytest.approx(0.05, abs=2e-3)
    assert share.max() == pytest.approx(1.0, abs=1e-3)
    assert share[0] < 0.9 * share.max()
    # The lamp stands at y > 0, 0.56 rad beside the camera: half of that is the normal's turn.
    middle = int(np.argmax(share))
    turn = np.arctan2(0.25, 0.4) / 2.0
    side = np.cross([0.0, 0.0, 1.0], camera - line[middle])[1]
    assert place[middle] == pytest.approx(np.sign(side) * np.sin(turn), abs=0.02)
    # From the other side it is the other half.
    _, other = mirrored(line, camera, lamp * [1.0, -1.0, 1.0], Metal())
    assert other[middle] == pytest.approx(-place[middle], abs=1e-9)


def test_a_shaft_that_bends_away_is_dark() -> None:
    camera, lamp = np.array([0.5, 0.0, 0.05]), np.array([0.4, 0.1, 0.05])
    up = shaft(0.0) + np.linspace(0.0, 1.0, 200)[:, None] ** 2 * [0.03, 0.0, 0.0]
    share, _ = mirrored(up, camera, lamp, Metal(spread=0.1))
    assert share[-1] < 0.02


def test_the_core_lies_on_the_lamp_s_side_in_the_image(rig: StereoRig) -> None:
    plant = NeedlePlant(initial_pose(0.0, 0.0), curvature=1e-3)
    plant.advance(0.1, 0.0)
    scenario = dataclasses.replace(STILL, metal=Metal(spread=0.5, core=250.0))
    checked = 0
    for seed in range(1, 5):
        renderer = StereoRenderer(rig, seed, scenario=scenario)
        lamp = place_lamp(np.random.default_rng([seed, 0, 5, 3]))
        images = renderer.render(plant.T_rig_tip, plant.centreline(0.001), 0)
        for image, camera in zip(images, (rig.left, rig.right), strict=True):
            u, v = np.rint(project(plant.T_rig_tip[:3, 3] * 0.5, camera)).astype(int)
            column = image[v - 12 : v + 13, u - 5 : u + 6].mean(axis=1)
            dark = np.flatnonzero(column < 150.0)
            inside = np.arange(dark[0], dark[-1] + 1)
            # Image v runs along rig y.
            off = np.average(inside, weights=column[inside] ** 4) - inside.mean()
            towards = np.sign(lamp[1] - camera.centre[1])
            if abs(lamp[1] - camera.centre[1]) > 0.1:
                assert np.sign(off) == towards
                checked += 1
    assert checked >= 4


def test_paper_s_lines_are_where_its_floor_is(rig: StereoRig) -> None:
    paper = GraphPaper(floor_depth=0.03, pitch=0.01)
    lines = paper_lines(paper, rig.half_height, np.random.default_rng(1))
    assert len(lines) > 20
    assert all(line[:, 0] == pytest.approx(rig.half_height - 0.03) for line in lines)
    along = [line[-1] - line[0] for line in lines]
    ways = np.array([way / np.linalg.norm(way) for way in along])
    # Two sets, across each other.
    products = np.abs(ways @ ways[0])
    assert np.all((products > 0.999) | (products < 0.001))
    ruled = StereoRenderer(rig, 2, scenario=dataclasses.replace(STILL, paper=paper))
    plain = StereoRenderer(rig, 2, scenario=STILL)
    nothing = (np.eye(4), np.zeros((1, 3)), 0)
    taken = plain.render(*nothing)[0].astype(float) - ruled.render(*nothing)[0]
    drawn = paper_lines(paper, rig.half_height, np.random.default_rng([2, 0, 5, 4]))
    for line in drawn:
        u, v = np.rint(project(line[len(line) // 2], rig.left)).astype(int)
        if 150 < u < 1000 and 20 < v < 740:
            assert taken[v - 1 : v + 2, u - 1 : u + 2].max() > 20.0
    assert np.median(taken) == 0.0
