"""Camera effects: an image keeps its geometry and gets the requested brightness."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_bringup.training.samples import CameraEffects

PLAIN = CameraEffects(
    haze=0.0,
    haze_level=100.0,
    gamma=1.0,
    gain=1.0,
    blur_px=0.3,
    shrink=1.0,
    noise=0.0,
    noise_share=0.0,
    noise_blur_px=0.0,
    denoise="",
    sharpen=0.0,
    sharpen_px=1.0,
    quality=0,
)


def scene() -> np.ndarray:
    image = np.full((96, 96), 60.0, np.float32)
    image[40:52, 30:60] = 180.0
    return image


def centre(image: np.ndarray) -> np.ndarray:
    bright = np.clip(image.astype(float) - np.median(image) - 20.0, 0.0, None)
    rows, columns = np.indices(image.shape)
    return np.array([(bright * axis).sum() / bright.sum() for axis in (rows, columns)])


@pytest.mark.parametrize(
    "changes",
    [
        {"blur_px": 2.5},
        {"shrink": 0.83},
        {"noise": 6.0, "noise_blur_px": 0.8},
        {"noise": 6.0, "denoise": "median"},
        {"noise": 6.0, "denoise": "bilateral"},
        {"sharpen": 1.2},
        {"quality": 10},
        {"haze": 0.4},
        {"gamma": 0.7},
        {"gain": 0.4},
    ],
    ids=str,
)
def test_camera_effects_do_not_move_the_image(changes: dict[str, object]) -> None:
    effects = dataclasses.replace(PLAIN, **changes)  # type: ignore[arg-type]
    seen = effects.apply(np.random.default_rng(0), scene())
    assert seen.dtype == np.uint8
    assert seen.shape == scene().shape
    np.testing.assert_allclose(centre(seen), centre(scene()), atol=0.3)


def test_a_plain_camera_changes_only_edges_and_gain_and_noise_are_as_requested() -> None:
    plain = PLAIN.apply(np.random.default_rng(0), scene())
    assert np.abs(plain.astype(float) - scene())[:36].max() == 0.0
    dark = dataclasses.replace(PLAIN, gain=0.5).apply(np.random.default_rng(0), scene())
    assert dark[0, 0] == 30
    noisy = dataclasses.replace(PLAIN, noise=5.0).apply(np.random.default_rng(0), scene())
    assert noisy[:36].std() == pytest.approx(5.0, rel=0.1)
