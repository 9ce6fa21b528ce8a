from __future__ import annotations

import base64
import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from needle_analysis.figures.film import MOST_FRAMES, READINGS, film_of
from needle_analysis.figures.film_views import MOST_BYTES, _small_jpeg, plan_views
from needle_analysis.report import report
from needle_bags.reading.bag_images import images_at
from needle_bags.reading.bag_reader import Run, Series, read_run

MakeRun = Callable[..., Path]

REGRESSION = Path(__file__).resolve().parents[5] / "bags" / "regression"
STEP_NS = 520_000_000


def film_in(page: str) -> Any:
    (text,) = re.findall(r'<script type="application/json" id="film-data">(.*?)</script>', page)
    return json.loads(text)


def decoded(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), 0)
    assert image is not None
    return np.asarray(image)


def without_truth(run: Run) -> Run:
    nothing = Series(run.truth.stamps[:0], run.truth.values[:0], run.truth.received[:0])
    return dataclasses.replace(run, truth=nothing)


def test_frames_are_exposures_of_the_bag_in_order_and_evenly_apart(make_run: MakeRun) -> None:
    frames = film_of(read_run(make_run()))
    stamps = [frame.stamp for frame in frames]
    assert stamps == [2 * STEP_NS * number for number in range(MOST_FRAMES)]
    depths = [float(frame.readings[0].removesuffix(" mm")) for frame in frames]
    assert depths == [2.0 * number for number in range(MOST_FRAMES)]


def test_no_frame_is_spent_where_the_needle_rests(make_run: MakeRun) -> None:
    run = read_run(make_run())
    depth = np.minimum(run.joints.values[:, 0], 0.1)
    resting = Series(
        run.joints.stamps, np.column_stack([depth, run.joints.values[:, 1]]), run.joints.received
    )
    frames = film_of(dataclasses.replace(run, joints=resting))
    insertions = run.insertion_at(np.array([frame.stamp for frame in frames]))
    assert insertions.max() <= 0.1 + 1e-9
    assert len(frames) > MOST_FRAMES // 2
    # Drawn out again: that is part of the film.
    there_and_back = 0.06 - np.abs(run.joints.values[:, 0] - 0.06)
    moved = Series(
        run.joints.stamps,
        np.column_stack([there_and_back, run.joints.values[:, 1]]),
        run.joints.received,
    )
    assert film_of(dataclasses.replace(run, joints=moved))[-1].stamp == run.tips.stamps[-1]


def test_the_needle_ends_where_the_tip_of_its_frame_is(make_run: MakeRun) -> None:
    run = read_run(make_run())
    for frame in film_of(run)[1:]:
        here = run.truth.stamps == frame.stamp
        assert np.array_equal(frame.needle[-1], run.truth.values[here, :3][0])
        assert np.array_equal(frame.shaft[-1], run.tips.values[run.tips.stamps == frame.stamp][0])
        assert np.array_equal(frame.shaft[0], np.zeros(3))
        assert np.all(np.diff(frame.needle[:, 2]) > 0.0)
    for frame in film_of(without_truth(run))[1:]:
        assert np.array_equal(frame.needle, frame.shaft)


def test_readings_are_those_of_the_frame(make_run: MakeRun) -> None:
    run = read_run(make_run())
    told = dict(zip(READINGS, film_of(run)[-1].readings, strict=True))
    assert told["Insertion"] == "120.0 mm"
    assert told["r1, true"] == "-0.25 mm"
    assert told["r1, estimated"] == "-0.15 mm"
    assert told["Roll, estimated"] == "+1 deg"
    assert told["Base turned"] == f"{np.degrees(12.0):.0f} deg"
    assert told["Controller"] == "-"
    values = {"trusted": "doubtful: it jumps", "r1_low_m": "-0.001", "r1_high_m": "0.002"}
    statuses = [
        dataclasses.replace(status, values={**status.values, **values})
        for status in run.controller_status
    ]
    doubtful = film_of(dataclasses.replace(run, controller_status=statuses))[-1].readings
    assert doubtful[2] == "-0.15 mm ± 1.50"
    assert doubtful[-1] == "doubtful"


def test_a_tip_that_is_not_a_number_is_no_needle(make_run: MakeRun) -> None:
    frames = film_of(read_run(make_run(bad_tip=60)))
    assert len(frames[30].shaft) == 0
    assert len(frames[31].shaft) > 0


def test_the_drawings_show_the_needle_where_it_is(make_run: MakeRun) -> None:
    run = read_run(make_run())
    frames = film_of(run)
    side, above = plan_views(run, frames)
    for view, axis in ((side, 0), (above, 1)):
        ends = np.array([line[-1] for line in view.lines])
        true = np.array([frame.needle[-1] for frame in frames])
        # To the right with depth, upwards with x or y; straight in both.
        for pixels, metres, sign in ((ends[:, 0], true[:, 2], 1), (ends[:, 1], true[:, axis], -1)):
            slope, offset = np.polyfit(metres, pixels, 1)
            assert np.sign(slope) == sign
            assert np.allclose(slope * metres + offset, pixels, atol=1e-6)
        assert ends.min() > 0.0
        assert np.all(ends < np.array(view.size))


def test_the_page_has_the_pictures_of_the_bag_in_order(make_run: MakeRun) -> None:
    bag = make_run(image_height=3)
    assert report.main([str(bag)]) == 0
    film = film_in((bag / "report.html").read_text())
    assert len(film["readings"]) == MOST_FRAMES
    left, right, *drawn = film["views"]
    assert [view["pictures"] for view in drawn] == [None, None]
    for view in (left, right):
        shades = [np.median(decoded(base64.b64decode(data))) for data in view["pictures"]]
        # The made-up images are as bright as their number.
        assert np.abs(np.array(shades) - 2.0 * np.arange(MOST_FRAMES)).max() <= 2.0


def test_the_film_of_real_cameras_has_the_tip_where_it_is_seen(tmp_path: Path) -> None:
    assert report.main([str(REGRESSION), "--output", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    film, run = film_in(page), read_run(REGRESSION)
    frames = film_of(run)
    stamps = np.array([frame.stamp for frame in frames])
    assert len(film["readings"]) == len(frames) == len(set(stamps.tolist()))
    images = {(index, side): image for index, side, image in images_at(run, stamps)}
    for view, side in zip(film["views"], ("left", "right"), strict=False):
        for index, line in enumerate(view["lines"]):
            if float(film["readings"][index][0].split()[0]) < 20.0:
                continue
            u, v = (float(part) for part in line.split(" ")[-1].split(","))
            image = images[index, side]
            near = image[int(v) - 6 : int(v) + 7, int(u) - 6 : int(u) + 7]
            # The steel is darker than what is around it.
            assert near.min() < np.median(image[int(v) - 40 : int(v) + 41, int(u) : int(u) + 41])
    assert len(page) < 6e6


@pytest.mark.parametrize("shape", [(768, 1024), (2000, 300), (7, 5)])
def test_a_picture_is_small_whatever_it_shows(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    data = _small_jpeg(noise)
    assert 0 < len(data) <= MOST_BYTES
    height, width = decoded(data).shape
    assert height <= 400
    assert width <= 480
    assert height / width == pytest.approx(shape[0] / shape[1], rel=0.02)
