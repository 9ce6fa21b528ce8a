"""The scenarios' troubles: repeatable, where geometry puts them, and nothing else changed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.optimize import fsolve

from needle_core.errors import OutOfBoundsError, UserError
from needle_sim.camera.bubbles import BubbleCloud
from needle_sim.camera.optics import Optics
from needle_sim.camera.passing import Event, cable_line, event_at
from needle_sim.camera.projection import project
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.scenarios import (
    CLEAN,
    SCENARIOS,
    Bubbles,
    Cable,
    FloorShadow,
    Glints,
    Lens,
    Lighting,
    Occlusion,
    Scenario,
    find_scenario,
)
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig, load_stereo_rig
from needle_sim.camera.window import SimulatedWindow
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.plant import NeedlePlant, initial_pose

CALIBRATION = Path(__file__).parents[3] / "needle_tracker" / "config" / "calibration.yaml"
GOLDEN = Path(__file__).parent / "data" / "clean_tip.png"
CURVATURE = 1.0 / 0.122
NO_NEEDLE = np.zeros((1, 3))
Pair = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def rig() -> StereoRig:
    return load_stereo_rig(CALIBRATION)


def needle(length: float = 0.08, curvature: float = CURVATURE) -> NeedlePlant:
    plant = NeedlePlant(initial_pose(*np.deg2rad([2.0, 15.0])), curvature=curvature)
    plant.advance(length, 0.0)
    return plant


def render(renderer: StereoRenderer, plant: NeedlePlant | None, number: int) -> Pair:
    if plant is None:
        return renderer.render(np.eye(4), NO_NEEDLE, number)
    return renderer.render(plant.T_rig_tip, plant.centreline(0.001), number)


def taken(with_it: Pair, without: Pair) -> np.ndarray:
    """What something takes from both images; the same exposure has the same noise."""
    return np.asarray(np.stack(without).astype(float) - np.stack(with_it))


def cameras(rig: StereoRig) -> tuple[SimulatedCamera, SimulatedCamera]:
    return rig.left, rig.right


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_scenario_repeats_whatever_was_rendered_before(rig: StereoRig, name: str) -> None:
    plant = needle()
    one = StereoRenderer(rig, 5, scenario=SCENARIOS[name])
    first = [render(one, plant, number) for number in (31, 3)]
    two = StereoRenderer(rig, 5, scenario=SCENARIOS[name])
    second = [render(two, plant, number) for number in (3, 31)]
    np.testing.assert_array_equal(first, second[::-1])
    other = StereoRenderer(rig, 6, scenario=SCENARIOS[name])
    assert np.any(render(other, plant, 3)[0] != first[1][0])
    assert np.any(first[0][0] != first[1][0])


def test_clean_is_what_it_always_was(rig: StereoRig) -> None:
    left, _ = render(StereoRenderer(rig, 5), needle(), 7)
    golden = cv2.imread(str(GOLDEN), cv2.IMREAD_GRAYSCALE)
    assert golden is not None
    u, v = project(needle().T_rig_tip[:3, 3], rig.left).astype(int)
    difference = np.abs(left[v - 40 : v + 40, u - 80 : u + 40].astype(int) - golden)
    # Other processors blur the mottle with other roundings.
    assert difference.max() <= 1
    assert np.mean(difference > 0) < 0.01


def test_absent_shows_the_same_whatever_the_stage_does(rig: StereoRig) -> None:
    absent = StereoRenderer(rig, 5, scenario=SCENARIOS["absent"])
    heavy = StereoRenderer(rig, 5, scenario=SCENARIOS["heavy_clutter"])
    empty = render(heavy, None, 9)
    np.testing.assert_array_equal(render(absent, needle(), 9), empty)
    assert taken(render(heavy, needle(), 9), empty).max() > 60.0
    assert absent.share_seen(np.eye(4), NO_NEEDLE, 9) == (0.0, 0.0)


def test_noise_is_the_scenario_s(rig: StereoRig) -> None:
    renderer = StereoRenderer(rig, 5, scenario=dataclasses.replace(CLEAN, noise=5.0))
    difference = taken(render(renderer, None, 0), render(renderer, None, 1))
    assert difference.std() / np.sqrt(2.0) == pytest.approx(5.0, abs=0.1)
    silent = StereoRenderer(rig, 5, scenario=dataclasses.replace(CLEAN, noise=0.0))
    np.testing.assert_array_equal(render(silent, None, 0), render(silent, None, 1))
    with pytest.raises(OutOfBoundsError, match=r"noise = 51 grey levels"):
        Scenario("loud", "too much", noise=51.0)


def test_bubbles_are_seen_where_refraction_puts_them(rig: StereoRig) -> None:
    scenario = dataclasses.replace(CLEAN, noise=0.0, bubbles=Bubbles(14, 0.001, 0.0015))
    renderer = StereoRenderer(rig, 5, scenario=scenario)
    dark = taken(
        render(renderer, None, 0),
        render(StereoRenderer(rig, 5, scenario=dataclasses.replace(CLEAN, noise=0.0)), None, 0),
    )
    assert renderer.bubbles is not None
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
            depth = 0.0175 - renderer.bubbles.centre[i, 0]
            if depth > 0.02:
                assert np.linalg.norm(middle - straight[i]) > 2.0
            checked += 1
    assert checked >= 10


def test_a_bubble_hides_the_needle_only_from_above(
    rig: StereoRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = needle()
    point = plant.centreline(0.001)[30]
    troubled = dataclasses.replace(CLEAN, noise=0.0, bubbles=Bubbles(1, 0.001, 0.001))
    plain = StereoRenderer(rig, 5, scenario=dataclasses.replace(CLEAN, noise=0.0))
    expected = render(plain, plant, 0)
    change = []
    for height in (0.004, -0.004):
        # Where the left camera sees it at the same pixel as the needle.
        pixel = project(point, rig.left)

        def miss(yz: np.ndarray, x: float = point[0] + height, at: np.ndarray = pixel) -> object:
            return project([x, *yz], rig.left) - at

        centre = np.array([[point[0] + height, *fsolve(miss, point[1:])]])
        cloud = BubbleCloud(centre, np.array([0.0012]))
        monkeypatch.setattr("needle_sim.camera.renderer.place_bubbles", lambda *_, c=cloud: c)
        seen = render(StereoRenderer(rig, 5, scenario=troubled), plant, 0)
        column, row = np.rint(pixel).astype(int)
        change.append(abs(float(seen[0][row, column]) - float(expected[0][row, column])))
        beside = taken(seen, expected)[0][row - 8 : row + 9, column - 8 : column + 9]
        assert beside.max() > 20.0
    assert change[0] > 20.0
    assert change[1] <= 1.0


def centroids(dark: np.ndarray, columns: np.ndarray, guess: np.ndarray) -> np.ndarray:
    rows = np.rint(guess).astype(int)[:, np.newaxis] + np.arange(-14, 15)
    part = np.clip(dark[rows, columns[:, np.newaxis]], 0.0, None)
    return np.asarray((part * rows).sum(axis=1) / part.sum(axis=1))


@pytest.mark.parametrize("floor_depth", [0.030, 0.035])
def test_the_shadow_lies_on_the_floor(rig: StereoRig, floor_depth: float) -> None:
    trouble = FloorShadow(floor_depth=floor_depth)
    scenario = dataclasses.replace(CLEAN, noise=0.0, shadow=trouble)
    # Seed 3's light throws the shadow clear of the needle in both views.
    straight = NeedleShape(bend_angle=2e-9, lean=1e-9)
    plant = needle(0.09, 0.0)
    plain = StereoRenderer(rig, 3, straight, dataclasses.replace(CLEAN, noise=0.0))
    dark = taken(
        render(StereoRenderer(rig, 3, straight, scenario), plant, 0), render(plain, plant, 0)
    )
    assert dark.max() > 20.0
    columns = np.arange(320, 560, 20)
    strong = dark[:, :, columns].argmax(axis=1)
    left = centroids(dark[0], columns, strong[0])
    right = centroids(dark[1], np.arange(250, 650), dark[1][:, 250:650].argmax(axis=0))

    def right_row(u: float, v: float, depth: float) -> float:
        """Where the right camera sees what the left one sees at (u, v), if it is so deep."""
        height = 0.0175 - depth

        def miss(yz: np.ndarray) -> np.ndarray:
            return project([height, *yz], rig.left) - [u, v]

        u_right, v_right = project([height, *fsolve(miss, [0.0, 0.05])], rig.right)
        return float(v_right - np.interp(u_right, np.arange(250, 650), right))

    misses = [right_row(float(u), v, floor_depth) for u, v in zip(columns, left, strict=True)]
    assert np.abs(misses).max() < 0.3
    higher = [
        right_row(float(u), v, floor_depth - 0.003) for u, v in zip(columns, left, strict=True)
    ]
    assert np.abs(higher).min() > 3.0


def test_the_cable_lies_above_the_surface_and_moves(rig: StereoRig) -> None:
    scenario = dataclasses.replace(CLEAN, noise=0.0, cable=Cable())
    renderer = StereoRenderer(rig, 5, scenario=scenario)
    plain = StereoRenderer(rig, 5, scenario=dataclasses.replace(CLEAN, noise=0.0))
    lines = [cable_line(Cable(), 0.0175, n, np.random.default_rng(1)) for n in range(140)]
    assert all(np.all(line[:, 0] == 0.0205) for line in lines)
    middles = np.array([line[60, 1] for line in lines])
    assert np.abs(np.diff(middles)).max() < 0.005
    assert middles.min() < -0.01
    assert middles.max() > 0.01
    moved = [taken(render(renderer, None, n), render(plain, None, n)) for n in (0, 4)]
    for dark in moved:
        assert dark.max() > 60.0
    assert np.any(moved[0] != moved[1])


def test_a_drifting_light_swells_and_fades_alike_in_both_views(rig: StereoRig) -> None:
    lighting = Lighting(blotches=0.0, shade=0.0, drift=0.08, drift_period=40.0)
    renderer = StereoRenderer(rig, 5, scenario=dataclasses.replace(CLEAN, lighting=lighting))
    means = np.array(
        [[image.mean() for image in render(renderer, None, n)] for n in range(0, 40, 4)]
    )
    shares = means / means.mean(axis=0)
    assert np.ptp(shares[:, 0]) == pytest.approx(0.16, abs=0.02)
    np.testing.assert_allclose(shares[:, 0], shares[:, 1], atol=2e-3)


def test_glints_saturate_over_the_needle_and_differ_between_the_views(rig: StereoRig) -> None:
    glints = Glints(0, 12, 6, 0.008, 250.0)
    scenario = dataclasses.replace(CLEAN, noise=0.0, glints=glints)
    plant = needle()
    with_them = render(StereoRenderer(rig, 5, scenario=scenario), plant, 0)
    plain = StereoRenderer(rig, 5, scenario=dataclasses.replace(CLEAN, noise=0.0))
    brighter = -taken(with_them, render(plain, plant, 0))
    assert brighter.min() >= 0.0
    path = plant.centreline(0.0005)[10:]
    on_needle = []
    for image, camera in zip(brighter, cameras(rig), strict=True):
        u, v = np.rint(project(path, camera)).astype(int).T
        on_needle.append(image[v, u])
        assert on_needle[-1].max() > 60.0
    assert np.any(np.abs(on_needle[0] - on_needle[1]) > 30.0)


def test_blur_is_a_thin_lens_s_and_keeps_the_needle_s_darkness(rig: StereoRig) -> None:
    lens = Lens(focus_height=0.065, aperture=0.011)
    optics = Optics(rig.left, lens)
    heights = np.array([0.065, 0.0175, 0.0, -0.0175])
    points = np.zeros((4, 3))
    points[:, 0] = heights
    blur = np.asarray(optics.blur_px(points))
    assert blur[0] == pytest.approx(0.7, abs=1e-6)
    assert np.all(np.diff(blur) > 0.0)
    # At the surface, 500 mm away, focused at 452.5 mm; image distances by 1/f = 1/a + 1/b.
    focal = 16e-3
    image_at = [1.0 / (1.0 / focal - 1.0 / distance) for distance in (0.4525, 0.5)]
    disk = lens.aperture * (image_at[0] - image_at[1]) / image_at[1]
    pixel = image_at[0] / rig.left.camera_matrix[0, 0]
    assert np.sqrt(blur[1] ** 2 - 0.49) == pytest.approx(disk / pixel / 4.0, rel=0.01)

    plant = needle(0.09, 0.0)
    profiles = []
    for one in (None, lens):
        scenario = dataclasses.replace(CLEAN, noise=0.0, lens=one)
        renderer = StereoRenderer(rig, 5, scenario=scenario)
        dark = taken(render(renderer, plant, 0), render(renderer, None, 0))[0]
        row = int(dark[:, 400].argmax())
        profiles.append(dark[row - 25 : row + 26, 380:420].mean(axis=1))
    assert profiles[1].sum() == pytest.approx(profiles[0].sum(), rel=0.05)
    assert profiles[1].max() < 0.7 * profiles[0].max()


def test_events_come_in_every_stretch_and_in_every_kind() -> None:
    occlusion = Occlusion(first=20, every=40, length=14, length_both=6)
    events = [event_at(occlusion, 3, number) for number in range(20 + 40 * 30)]
    assert all(event is None for event in events[:20])
    kinds = set()
    for stretch in range(30):
        part = [e for e in events[20 + 40 * stretch : 60 + 40 * stretch] if e is not None]
        assert len({(e.blocks, e.covered) for e in part}) == 1
        assert len(part) == (6 if all(part[0].blocks) else 14)
        assert np.all(np.diff([e.progress for e in part]) > 0.0)
        kinds.add((part[0].blocks, part[0].covered))
    assert len(kinds) == 6


@pytest.mark.parametrize("covered", [False, True])
@pytest.mark.parametrize("blocks", [(True, False), (False, True), (True, True)])
@pytest.mark.parametrize("length", [0.02, 0.07, 0.12])
def test_an_event_blocks_whom_it_says(
    rig: StereoRig,
    monkeypatch: pytest.MonkeyPatch,
    blocks: tuple[bool, bool],
    covered: bool,
    length: float,
) -> None:
    event = Event(blocks, covered, 0.5)
    monkeypatch.setattr("needle_sim.camera.renderer.event_at", lambda *_: event)
    scenario = dataclasses.replace(CLEAN, noise=0.0, occlusion=Occlusion())
    renderer = StereoRenderer(rig, 5, scenario=scenario)
    plant = NeedlePlant(initial_pose(0.05, 0.3), curvature=2.0)
    plant.advance(length, 0.0)
    pose, line = plant.T_rig_tip, plant.centreline(0.001)
    assert renderer.share_seen(pose, line, 0) == tuple(float(not blocked) for blocked in blocks)
    dark = taken(renderer.render(pose, line, 0), renderer.render(pose, NO_NEEDLE, 0))
    for image, camera, blocked in zip(dark, cameras(rig), blocks, strict=True):
        u, v = np.rint(project(pose[:3, 3], camera)).astype(int)
        near = np.abs(image[v - 20 : v + 21, u - 40 : u + 5])
        assert near.max() <= 1.0 if blocked else near.max() > 60.0


def test_a_scenario_that_is_not_there_is_named() -> None:
    assert find_scenario("clean") is CLEAN
    with pytest.raises(UserError, match="scenario 'fog' is not one of clean, clutter, heavy_clu"):
        find_scenario("fog")
