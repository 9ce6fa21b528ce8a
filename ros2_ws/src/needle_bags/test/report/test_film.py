from __future__ import annotations

import base64
import dataclasses
import json
import re
from typing import Any

import cv2
import numpy as np
import pytest

from needle_bags.figures.film import (
    MAX_BYTES,
    MAX_FRAMES,
    READINGS,
    _small_jpeg,
    film_of,
    plan_views,
    projections,
)
from needle_bags.reading.bag_images import images_at
from needle_bags.reading.bag_reader import Run, Series

STEP_NS = 520_000_000


def decoded(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), 0)
    assert image is not None
    return np.asarray(image)


def with_depth(run: Run, depth: np.ndarray) -> Run:
    values = np.column_stack([depth, run.joints.values[:, 1]])
    return dataclasses.replace(run, joints=dataclasses.replace(run.joints, values=values))


def test_frames_are_equally_spaced_and_end_at_their_tip(made_up: Run) -> None:
    frames = film_of(made_up)
    assert [frame.stamp for frame in frames] == [2 * STEP_NS * n for n in range(MAX_FRAMES)]
    depths = [float(frame.readings[0].removesuffix(" mm")) for frame in frames]
    assert depths == [2.0 * number for number in range(MAX_FRAMES)]
    nothing = Series(made_up.truth.stamps[:0], made_up.truth.values[:0], made_up.truth.stamps[:0])
    blind = film_of(dataclasses.replace(made_up, truth=nothing))
    for frame, measured in zip(frames[1:], blind[1:], strict=True):
        here = made_up.truth.stamps == frame.stamp
        assert np.array_equal(frame.needle[-1], made_up.truth.values[here, :3][0])
        tip = made_up.tips.values[made_up.tips.stamps == frame.stamp][0]
        assert np.array_equal(frame.shaft[-1], tip)
        # Without ground truth, the measured tip is shown.
        assert np.array_equal(measured.needle, frame.shaft)


def test_a_resting_needle_takes_no_frames(made_up: Run) -> None:
    run = with_depth(made_up, np.minimum(made_up.joints.values[:, 0], 0.1))
    frames = film_of(run)
    insertions = run.insertion_at(np.array([frame.stamp for frame in frames]))
    assert insertions.max() <= 0.1 + 1e-9
    assert len(frames) > MAX_FRAMES // 2
    # A withdrawal is part of the film.
    there_and_back = 0.06 - np.abs(made_up.joints.values[:, 0] - 0.06)
    assert film_of(with_depth(made_up, there_and_back))[-1].stamp == made_up.tips.stamps[-1]


def test_readings_belong_to_their_frame(made_up: Run) -> None:
    readings = dict(zip(READINGS, film_of(made_up)[-1].readings, strict=True))
    assert list(readings.values()) == [
        *("120.0 mm", "-0.25 mm", "-0.15 mm", readings["Pitch, estimated"], "+1 deg"),
        f"{np.degrees(12.0):.0f} deg",
    ]


def test_the_drawings_are_to_scale(made_up: Run) -> None:
    frames = film_of(made_up)
    side, above = plan_views(made_up, frames)
    true = np.array([frame.needle[-1] for frame in frames])
    for view, axis in ((side, 0), (above, 1)):
        ends = np.array([line[-1] for line in view.lines])
        # Depth points right, x or y upwards; both are linear.
        for pixels, metres, sign in ((ends[:, 0], true[:, 2], 1), (ends[:, 1], true[:, axis], -1)):
            slope, offset = np.polyfit(metres, pixels, 1)
            assert np.sign(slope) == sign
            assert np.allclose(slope * metres + offset, pixels, atol=1e-6)
        assert ends.min() > 0.0
        assert np.all(ends < np.array(view.size))


def test_the_film_marks_the_tip_in_camera_images(
    reported: tuple[Run, str],
) -> None:
    run, page = reported
    (text,) = re.findall(r'<script type="application/json" id="film-data">(.*?)</script>', page)
    film: Any = json.loads(text)
    frames = film_of(run)
    stamps = np.array([frame.stamp for frame in frames])
    assert len(film["readings"]) == len(frames) == len(set(stamps.tolist()))
    images = {(index, side): image for index, side, image in images_at(run, stamps)}
    projection_of, checked = projections(run), 0
    for view, side in zip(film["views"], ("left", "right"), strict=False):
        assert decoded(base64.b64decode(view["pictures"][0])).size
        for index, line in enumerate(view["lines"]):
            u, v = (float(part) for part in line.split(" ")[-1].split(","))
            measured = projection_of[side](frames[index].shaft)[-1]
            assert (u, v) == pytest.approx(measured.tolist(), abs=0.051)
            image = images[index, side]
            near = image[int(v) - 6 : int(v) + 7, int(u) - 6 : int(u) + 7]
            # The steel is darker than its surroundings.
            assert near.min() < np.median(image[int(v) - 40 : int(v) + 41, int(u) : int(u) + 41])
            checked += 1
    assert checked == 12
    assert len(page) < 6e6


@pytest.mark.parametrize("shape", [(2000, 300), (7, 5)])
def test_a_picture_of_noise_is_small(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    data = _small_jpeg(noise)
    assert 0 < len(data) <= MAX_BYTES
    height, width = decoded(data).shape
    assert height <= 400
    assert width <= 480
    assert height / width == pytest.approx(shape[0] / shape[1], rel=0.02)
