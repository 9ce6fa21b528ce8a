"""The path tracer, if it is installed: an extra that `scripts/test` does not install."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from needle_core.errors import UserError
from needle_core.files.installed import find_shared_file
from needle_sim.camera.optics import project
from needle_sim.camera.stereo_rig import SimulatedCamera, StereoRig, load_stereo_rig
from needle_sim.path_traced.appearance import draw_appearance
from needle_sim.path_traced.insertion import trace_insertion
from needle_sim.path_traced.path_tracing import PathTracer, refracted_rays
from needle_sim.path_traced.scene import Scene
from needle_sim.path_traced.tracer import MM, Mitsuba, load_mitsuba
from needle_sim.path_traced.world import make_world
from needle_sim.sequences.boxes import draw_box
from needle_sim.sequences.render_images import main

CALIBRATION = Path(find_shared_file("needle_tracker", "config/calibration.yaml"))
TOP_AND_SIDE = CALIBRATION.with_name("calibration_top_and_side.yaml")
POINTS = np.array([[0.0, 0.0, 0.03], [0.012, 0.03, 0.09], [-0.014, -0.035, 0.12]])


class BareScene(NamedTuple):
    """Scene data that `PathTracer` needs."""

    tracer: Any
    floors: list[Any]


@pytest.fixture(scope="module")
def mitsuba() -> Mitsuba:
    pytest.importorskip("mitsuba", reason="Mitsuba is an extra: docs/dependencies.md")
    try:
        return load_mitsuba()
    except UserError as error:
        pytest.skip(str(error))


def quarter_size(rig: StereoRig) -> StereoRig:
    """Return the rig with images of a quarter of the width and height."""

    def smaller(camera: SimulatedCamera) -> SimulatedCamera:
        matrix = camera.camera_matrix.copy()
        matrix[:2] /= 4.0
        return dataclasses.replace(camera, image_width=256, image_height=192, camera_matrix=matrix)

    return dataclasses.replace(rig, left=smaller(rig.left), right=smaller(rig.right))


@pytest.mark.parametrize("calibration", [CALIBRATION, TOP_AND_SIDE])
@pytest.mark.parametrize("point", POINTS)
def test_a_small_bright_sphere_is_imaged_according_to_snells_law(
    mitsuba: Mitsuba, point: np.ndarray, calibration: Path
) -> None:
    rig = load_stereo_rig(calibration)
    floor = mitsuba.mi.load_dict({"type": "rectangle"})
    sphere = {
        "type": "sphere",
        "center": (MM * point).tolist(),
        "radius": 0.1,
        "emitter": {"type": "area", "radiance": 1.0},
    }
    scene = BareScene(mitsuba.mi.load_dict({"type": "scene", "sphere": sphere}), [floor])
    for camera in (rig.left, rig.right):
        expected = project(point, camera)
        corner = np.rint(expected).astype(int) - 4
        pixels = corner + np.mgrid[:9, :9].reshape(2, -1).T
        light, cover, travelled = PathTracer(mitsuba, rig).layer(
            scene,  # type: ignore[arg-type]
            pixels,
            camera,
            samples=256,
            key=[1],
        )
        np.testing.assert_allclose(light, cover, atol=1e-5)
        rays = refracted_rays(expected, camera, rig)
        assert travelled.sum() / cover.sum() == pytest.approx(
            np.linalg.norm(point - rays.origin), abs=2e-4
        )
        pixel = (light[:, np.newaxis] * pixels).sum(axis=0) / light.sum()
        assert np.abs(pixel - expected).max() < 0.1


def test_the_same_seed_gives_the_same_pairs_with_a_needle_in_them(mitsuba: Mitsuba) -> None:
    rig = quarter_size(load_stereo_rig(CALIBRATION))
    look = dataclasses.replace(
        draw_appearance("oxide_on_grey", 3), noise=0.4, shot_noise=0.5, lag=0.0
    )
    bare = dataclasses.replace(look, needle=False)

    def pairs(which: Any) -> list[Any]:
        return list(trace_insertion(mitsuba, rig, which, frames=2, depth=0.05, begin=0.04))

    first, second, without = pairs(look), pairs(look), pairs(bare)
    for one, other, empty in zip(first, second, without, strict=True):
        assert one.truth is not None
        assert empty.truth is None
        for image, same, nothing, camera in zip(
            one.images, other.images, empty.images, (rig.left, rig.right), strict=True
        ):
            np.testing.assert_array_equal(image, same)
            shaft = one.meshes[0].parts["shaft"].points[::40]
            pixel = project(shaft, camera)
            u, v = np.rint(pixel[pixel[:, 0] > 30.0]).astype(int).T
            darker = nothing[v, u].astype(float) - image[v, u]
            assert np.median(darker) > 20.0


def test_the_command_fills_a_folder(mitsuba: Mitsuba, tmp_path: Path) -> None:
    argv = ["--renderer", "path_traced", "--appearance", "absent", "--frames", "1"]
    output = tmp_path / "out"
    assert main(["--output", str(output), "--calibration", str(CALIBRATION), *argv]) == 0
    with (output / "truth.csv").open(encoding="utf-8", newline="") as stream:
        (row,) = csv.DictReader(stream)
    assert row["axis_x_mm"] == row["needle"] == ""
    assert row["bottom"] != ""


def test_mirroring_the_floor_mirrors_its_image(mitsuba: Mitsuba) -> None:
    look = dataclasses.replace(draw_appearance("drawn_on_grey", 3), bubbles=0)
    world = make_world(load_stereo_rig(CALIBRATION), look)
    backdrop = world.backdrops[0]
    shape = backdrop.picture.shape
    slanting = np.linspace(0.1, 0.5, shape[0])[:, np.newaxis] + np.linspace(0.0, 0.4, shape[1])
    backdrop = dataclasses.replace(backdrop, picture=slanting.astype(np.float32))
    scene = Scene(mitsuba, dataclasses.replace(world, backdrops=(backdrop, backdrop)))
    points = np.array([[look.floor_height, y, z] for y in (-0.04, 0.05) for z in (0.02, 0.12)])
    above = (MM * (points + np.array([0.01, 0.0, 0.0]))).astype(np.float32)
    down = mitsuba.mi.Vector3f(-1.0, 0.0, 0.0)
    hit = scene.tracer.ray_intersect(mitsuba.mi.Ray3f(mitsuba.mi.Point3f(*above.T), down))
    pixel = np.asarray(hit.bsdf().eval_diffuse_reflectance(hit)).ravel()
    np.testing.assert_allclose(pixel, backdrop.reflectance(points[np.newaxis])[0], atol=0.002)


def test_a_needle_in_a_box_is_seen_by_both_and_farther_in_by_the_later_one(
    mitsuba: Mitsuba, tmp_path: Path
) -> None:
    path = tmp_path / "box.yaml"
    path.write_text(draw_box(4), encoding="utf-8")
    rig = load_stereo_rig(path)
    look = dataclasses.replace(draw_appearance("oxide_over_lit_panel", 4), lag=0.0, tracks=0)
    bare = dataclasses.replace(look, needle=False)
    late = dataclasses.replace(look, lag=0.002)
    first, without, later = (
        next(trace_insertion(mitsuba, rig, which, frames=1, depth=0.06, begin=0.05))
        for which in (look, bare, late)
    )
    assert first.truth is not None
    assert first.meshes is not None
    assert later.truth is not None
    assert later.meshes is not None
    np.testing.assert_array_equal(first.images[0], later.images[0])
    for side, camera in enumerate((rig.left, rig.right)):
        line = first.meshes[side].line
        u, v = np.rint(project(line[line[:, 2] > 0.004][::5], camera)).astype(int).T
        darker = without.images[side][v, u].astype(float) - first.images[side][v, u]
        assert np.median(darker) > 20.0
    assert later.truth.tip == pytest.approx(first.truth.tip)
    ends = [mesh.line[-1, 2] for mesh in later.meshes]
    assert ends[1] - ends[0] == pytest.approx(0.002, abs=1e-4)
    assert np.any(later.images[1] != first.images[1])


def test_haze_fades_deep_objects_and_not_near_ones(mitsuba: Mitsuba) -> None:
    rig = quarter_size(load_stereo_rig(CALIBRATION))
    look = dataclasses.replace(
        draw_appearance("painted_on_print", 3), bubbles=0, noise=0.4, lag=0.0, flicker=0.0
    )
    clear, hazy = (
        next(
            trace_insertion(
                mitsuba, rig, dataclasses.replace(look, haze=haze), frames=1, depth=0.05, begin=0.05
            )
        )
        .images[0][:, 60:]
        .astype(float)
        for haze in (0.0, 0.35)
    )
    assert np.median(hazy) == pytest.approx(np.median(clear), abs=6.0)
    assert 0.5 < hazy.std() / clear.std() < 0.8
