"""Camera effects: an image keeps its geometry."""

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
        {"noise": 6.0, "denoise": "bilateral"},
        {"sharpen": 1.2},
        {"quality": 10},
    ],
    ids=str,
)
def test_camera_effects_do_not_move_the_image(changes: dict[str, object]) -> None:
    effects = dataclasses.replace(PLAIN, **changes)  # type: ignore[arg-type]
    seen = effects.apply(np.random.default_rng(0), scene())
    assert seen.dtype == np.uint8
    assert seen.shape == scene().shape
    np.testing.assert_allclose(centre(seen), centre(scene()), atol=0.3)
