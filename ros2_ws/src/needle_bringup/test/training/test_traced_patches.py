"""Path-traced scenes and the samples cut from them: the labels follow the image."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from needle_bringup.training import traced_scenes
from needle_bringup.training.samples import CANVAS, SIZE
from needle_bringup.training.traced_patches import Cut, traced_patch
from needle_bringup.training.traced_scenes import TracedScene, shaft_share, trace_scene
from needle_core.files.installed import find_shared_file
from needle_sim.camera.optics import project
from needle_sim.camera.stereo_rig import load_stereo_rig

RIG = load_stereo_rig(find_shared_file("needle_tracker", "config/calibration_top_and_side.yaml"))


def bars(width_px: float) -> TracedScene:
    """Return a scene with ever longer bright bars as needles, in front of grain."""
    shares = np.zeros((6, 300, 400), np.uint8)
    half = round(0.5 * width_px)
    ends = np.full((6, 2), np.nan)
    for i, length in zip(range(2, 6), (150, 150, 250, 250), strict=True):
        shares[i, 150 - half : 150 + half, :length] = 255
        ends[i] = length - 0.5, 149.5
    grain = np.random.default_rng(0).integers(20, 60, shares.shape[1:]).astype(np.uint8)
    images = np.where(shares > 0, np.uint8(230), grain)
    return TracedScene(images, shares, ends, np.full(6, 2.0 * half))


@pytest.mark.parametrize(("scale", "angle"), [(1.0, 0.0), (0.5, 1.0), (1.6, -2.0)])
def test_points_are_cut_with_the_image(scale: float, angle: float) -> None:
    image = np.zeros((300, 400), np.uint8)
    image[148:151, 198:201] = 200
    cut = Cut(np.array([210.0, 140.0]), scale, angle)
    seen = cut.image(image).astype(float)
    rows, columns = np.indices(seen.shape)
    centre = [(seen * axis).sum() / seen.sum() for axis in (columns, rows)]
    np.testing.assert_allclose(cut.point(np.array([199.0, 149.0])), centre, atol=0.1)


@pytest.mark.parametrize("place", [(3.0, 5.0), (398.0, 297.0), (200.0, 2.0)])
def test_a_patch_at_the_border_is_whole(place: tuple[float, float]) -> None:
    image = np.full((300, 400), 77, np.uint8)
    assert (Cut(np.array(place), 0.4, 0.7).image(image) == 77).all()


@pytest.mark.parametrize("width_px", [4.0, 10.0])
def test_a_sample_and_its_labels_are_rotated_and_scaled_together(width_px: float) -> None:
    with_needle = ends = 0
    scene = bars(width_px)
    for seed in range(40):
        sample = traced_patch(np.random.default_rng(seed), [scene])
        share, image = sample.share / 255.0, sample.image.astype(float)
        assert image.shape == share.shape == (CANVAS, CANVAS)
        if (share > 0.95).sum() < 60:
            continue
        with_needle += 1
        # With every camera, the needle is brighter than its surroundings.
        assert image[share > 0.95].mean() > image[share < 0.01].mean()
        if (np.abs(sample.end - 0.5 * CANVAS) < 0.5 * SIZE - 12).all():
            ends += 1
            column, row = np.rint(sample.end).astype(int)
            around = share[row - 6 : row + 7, column - 6 : column + 7]
            # A shaft that ends there fills less than half of the surroundings.
            assert 0.02 < around.mean() < 0.62
    assert with_needle > 10
    assert ends > 5


def test_half_of_the_samples_have_a_background_of_the_same_camera() -> None:
    scene = bars(4.0)
    samples = [traced_patch(np.random.default_rng(seed), [scene]) for seed in range(60)]
    known = [sample for sample in samples if sample.background is not None]
    assert 20 < len(known) < 50
    # Where there is more needle than before, the image has changed.
    differences = [
        np.abs(sample.image.astype(float) - sample.background)[sample.share > 250].mean()
        for sample in known
        if sample.background is not None and (sample.share > 250).sum() > 60
    ]
    assert np.median(differences) > 20.0


def test_the_width_of_a_shaft_is_that_of_its_outline() -> None:
    line = np.linspace([0.0, 0.0, 0.001], [0.003, -0.004, 0.06], 200)
    ahead = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    # Surface points around the end: those farthest across the line are the edges.
    angle = np.linspace(0.0, 2.0 * np.pi, 400)[:, None]
    one = np.cross(ahead, [1.0, 0.0, 0.0])
    one /= np.linalg.norm(one)
    ring = line[-1] + 0.5e-3 * (np.cos(angle) * one + np.sin(angle) * np.cross(ahead, one))
    for camera in (RIG.left, RIG.right):
        share, end, width = shaft_share(line, 1e-3, camera)
        before, last = project(line[-2:], camera)
        along = (last - before) / np.linalg.norm(last - before)
        edges = (project(ring, camera) - last) @ [-along[1], along[0]]
        assert width == pytest.approx(np.ptp(edges), rel=0.1)
        length = np.linalg.norm(np.diff(project(line, camera), axis=0), axis=1).sum()
        assert share.sum(dtype=float) / 255.0 == pytest.approx(width * length, rel=0.05)
        np.testing.assert_allclose(end, last)


def test_a_scene_is_the_empty_phantom_then_a_needle_in_both_cameras(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    images = [
        np.zeros((camera.image_height, camera.image_width), np.uint8)
        for camera in (RIG.left, RIG.right)
    ]
    line = np.linspace([0.0, 0.0, -0.01], [0.003, -0.004, 0.06], 200)
    meshes = [SimpleNamespace(line=line)] * 2
    asked: dict[str, Any] = {}

    def trace(*_: object, **words: Any) -> list[SimpleNamespace]:
        asked.update(words)
        pairs = (None, meshes, meshes)
        return [SimpleNamespace(images=images, meshes=pair) for pair in pairs]

    monkeypatch.setattr(traced_scenes, "trace_insertion", trace)
    scene = trace_scene(SimpleNamespace(), RIG, 3)  # type: ignore[arg-type]
    assert asked["depth"] == pytest.approx(asked["begin"] + asked["step"] * (asked["frames"] - 1))
    assert not scene.shares[:2].any()
    assert np.isnan(scene.ends[:2]).all()
    assert scene.shares[2:].any(axis=(1, 2)).all()
    # In the empty phantom, the later place of the needle is as wide as in the first pair.
    np.testing.assert_array_equal(scene.widths_px[:2], scene.widths_px[2:4])
