"""The whole pipeline on drawn pairs and on the simulated bench's renderer (an independent one)."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from drawn_needles import arc
from needle_sim.camera.renderer import StereoRenderer
from needle_sim.camera.stereo_rig import load_stereo_rig
from needle_sim.needle.needle_shape import NeedleShape
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_tracker.detector.end_fit import FIT
from needle_tracker.filter import needle_tracker
from needle_tracker.filter.measurement import Measurement, NoTip, TrackState
from needle_tracker.filter.needle_tracker import NeedleTracker
from needle_tracker.filter.settings import FILTER
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.stereo.sighting import PAIRING, Ends, Sighting, StereoSearch
from needle_tracker.tracker_parameters import StereoTrackerParameters

Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]


@pytest.fixture
def tracker(calibration: StereoCalibration, settings: StereoTrackerParameters) -> NeedleTracker:
    return NeedleTracker(calibration, settings)


def steered(
    calibration_path: Path, rotation_per_length: float, roll: float, first_mm: int, last_mm: int
) -> list[tuple[float, np.ndarray, np.ndarray, np.ndarray]]:
    """Return (insertion, true tip pose, left, right) for each mm of a simulated insertion."""
    renderer = StereoRenderer(load_stereo_rig(calibration_path), 7)
    plant = NeedlePlant(initial_pose(math.radians(2.0), roll), curvature=8.2)
    exposures = []
    for number in range(1, last_mm + 1):
        plant.advance(1e-3, rotation_per_length * 1e-3)
        if number >= first_mm:
            pose = np.asarray(plant.T_rig_tip)
            left, right = renderer.render(pose, plant.centreline(5e-4), number)
            exposures.append((1e-3 * number, pose, left, right))
    return exposures


def tip_errors(measured: list[Measurement], truth: list[np.ndarray]) -> np.ndarray:
    errors = [
        m.tip.position - pose[:3, 3] if m.tip is not None else np.full(3, np.nan)
        for m, pose in zip(measured, truth, strict=True)
    ]
    return np.array(errors)


@pytest.mark.parametrize(
    ("rotation_per_length", "roll"), [(0.0, 0.0), (60.0, 2.5)], ids=["in plane", "spun"]
)
@pytest.mark.parametrize("insertion_known", [True, False])
def test_a_rendered_needle_is_measured_to_some_tenths_of_a_millimetre(
    tracker: NeedleTracker,
    calibration_path: Path,
    rotation_per_length: float,
    roll: float,
    insertion_known: bool,
) -> None:
    exposures = steered(calibration_path, rotation_per_length, roll, 80, 92)
    measured = [
        tracker.process(left, right, insertion if insertion_known else None)
        for insertion, _, left, right in exposures
    ]
    errors = tip_errors(measured, [pose for _, pose, _, _ in exposures])
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.2e-3
    assert all(m.state is TrackState.TRACKING for m in measured)
    for m, error, (_, pose, _, _) in zip(measured, errors, exposures, strict=True):
        assert m.tip is not None
        assert error @ np.linalg.solve(m.tip.covariance, error) < 20.0
        # The direction is that of the visible end, which leans from the heading.
        lean = NeedleShape().lean
        turned = m.tip.direction - pose[:3, :3] @ [0.0, -math.sin(lean), math.cos(lean)]
        spread = np.linalg.pinv(m.tip.direction_covariance, rcond=1e-6)
        assert turned @ spread @ turned < 20.0


def test_the_needle_is_detected_from_just_beyond_the_entry(
    tracker: NeedleTracker, calibration_path: Path
) -> None:
    exposures = steered(calibration_path, 0.0, 1.0, 2, 9)
    measured = [tracker.process(left, right, s) for s, _, left, right in exposures]
    states = [m.state for m in measured]
    assert states[0] is TrackState.ENTRY
    assert states[3:] == [TrackState.TRACKING] * 5
    errors = tip_errors(measured, [pose for _, pose, _, _ in exposures])
    assert np.linalg.norm(errors, axis=1).max() < 0.3e-3
    for m, error in zip(measured, errors, strict=True):
        assert m.tip is not None
        assert error @ np.linalg.solve(m.tip.covariance, error) < 20.0


def test_an_undetected_short_needle_is_placed_by_the_insertion(
    tracker: NeedleTracker, draw_pair: Drawer
) -> None:
    """A control loop must continue: only some mm deeper the needle can be detected or missed."""
    for insertion in (0.001, 0.005, 0.0079):
        measured = tracker.process(*draw_pair(None, noise=5.0), insertion)
        assert (measured.state, measured.reason) == (TrackState.ENTRY, "")
        assert measured.tip is not None
        assert measured.tip.position.tolist() == [0.0, 0.0, insertion]
        # The lateral sigma follows from the entry angle.
        assert measured.tip.covariance[0, 0] > (insertion * math.sin(math.radians(10.0))) ** 2
    assert tracker.process(*draw_pair(None, noise=5.0), 0.0081).tip is None


def test_same_images_give_the_same_bits(
    calibration: StereoCalibration, settings: StereoTrackerParameters, calibration_path: Path
) -> None:
    exposures = steered(calibration_path, 100.0, 0.0, 40, 43)
    runs = []
    for _ in range(2):
        tracker = NeedleTracker(calibration, settings)
        tips = [tracker.process(left, right, s).tip for s, _, left, right in exposures]
        runs.append(b"".join(t.position.tobytes() + t.covariance.tobytes() for t in tips if t))
    assert runs[0] == runs[1]
    assert len(runs[0]) == 4 * 12 * 8


def test_no_function_is_compiled_after_the_warm_up(
    tracker: NeedleTracker, draw_pair: Drawer
) -> None:
    """The length of the first needle must not cause a compilation, which takes seconds."""

    def compiled_for() -> dict[str, int]:
        return {
            f"{function.py_func.__module__}.{function.py_func.__qualname__}": len(
                function.signatures
            )
            for name, module in list(sys.modules.items())
            if name.startswith("needle_tracker.")
            for function in vars(module).values()
            if isinstance(function, Dispatcher)
        }

    tracker.warm_up()
    before = compiled_for()
    assert before["needle_tracker.optics.refraction._project"] == 1
    for length in (0.012, 0.11):
        images = draw_pair(arc(length, 4.0, 0.5))
        for insertion in (length, None):
            tracker.reset()
            for _ in range(2):
                tracker.process(*images, insertion)
    assert compiled_for() == before


@pytest.mark.parametrize(
    "insertions", [(0.009, 0.02), (0.08,), (0.12,), (None, None), (None, None, None)]
)
def test_an_absent_needle_is_never_found(
    tracker: NeedleTracker, draw_pair: Drawer, insertions: tuple[float | None, ...]
) -> None:
    """Sheath, hole, uneven light and noise are drawn, but no needle."""
    for seed, insertion in enumerate(insertions):
        measured = tracker.process(*draw_pair(None, seed=seed, noise=5.0), insertion)
        assert measured.tip is None
        assert measured.reason
        assert measured.state is TrackState.SEARCHING


def test_a_blocked_camera_loses_the_track_until_it_is_clear(
    tracker: NeedleTracker, draw_pair: Drawer
) -> None:
    left, right = draw_pair(arc(0.025, 5.0, 1.0))
    assert tracker.process(left, right, 0.025).state is TrackState.TRACKING
    blocked = np.full_like(right, 140)
    answers = [tracker.process(left, blocked, 0.025) for _ in range(FILTER.lost_after)]
    assert all(answer.reason == NoTip.NOTHING for answer in answers)
    assert answers[-1].state is TrackState.LOST
    assert answers[-1].tip is None
    again = tracker.process(left, right, 0.025)
    assert again.state is TrackState.TRACKING
    assert again.tip is not None


def test_without_an_encoder_a_needle_that_advanced_undetected_is_found_again(
    tracker: NeedleTracker, draw_pair: Drawer
) -> None:
    for mm in range(48, 52):
        tracker.process(*draw_pair(arc(1e-3 * mm, 5.0, 1.0), seed=mm), None)
    while (answer := tracker.skip("covered")).state is not TrackState.LOST:
        assert answer.tip is None
    for mm in range(65, 68):
        path = arc(1e-3 * mm, 5.0, 1.0)
        answer = tracker.process(*draw_pair(path, seed=mm), None)
    assert answer.tip is not None
    assert np.linalg.norm(answer.tip.position - path[-1]) < 0.25e-3


def test_without_an_encoder_a_needle_is_found_near_an_old_track(
    tracker: NeedleTracker, draw_pair: Drawer
) -> None:
    old, reasons = arc(0.045, 5.0, 0.5), []
    for mm in [40] * 2 + list(range(42, 50, 2)):
        path = arc(1e-3 * mm, 6.0, 2.6)
        (left, right), (old_left, old_right) = (draw_pair(each, seed=mm) for each in (path, old))
        answer = tracker.process(np.minimum(left, old_left), np.minimum(right, old_right), None)
        reasons.append(answer.reason)
        if answer.tip is not None:
            assert np.linalg.norm(answer.tip.position - path[-1]) < 0.25e-3
    assert set(reasons[:2]) == {NoTip.UNCONFIRMED}
    assert reasons[-2:] == ["", ""]


@pytest.mark.parametrize(
    ("is_known", "hidden_end", "sigmas", "searches"),
    [
        (True, FIT.hidden_end, PAIRING.sigmas, 1),
        (False, FIT.hidden_end, PAIRING.sigmas, 2),
        (True, 9.0, PAIRING.sigmas, 2),
        (True, FIT.hidden_end, 0.1, 2),
    ],
    ids=["predicted", "without insertion", "hidden", "elsewhere"],
)
def test_visible_ends_need_less_evidence_where_the_insertion_predicts_them(
    tracker: NeedleTracker,
    draw_pair: Drawer,
    monkeypatch: pytest.MonkeyPatch,
    is_known: bool,
    hidden_end: float,
    sigmas: float,
    searches: int,
) -> None:
    searched: list[float] = []
    search = StereoSearch.search

    def counted(self: StereoSearch, least: float, most: float) -> tuple[list[Sighting], Ends]:
        searched.append(most)
        return search(self, least, most)

    monkeypatch.setattr(StereoSearch, "search", counted)
    monkeypatch.setattr(needle_tracker, "evidence", lambda *_: -2.0)
    monkeypatch.setattr(needle_tracker, "FIT", dataclasses.replace(FIT, hidden_end=hidden_end))
    monkeypatch.setattr(needle_tracker, "PAIRING", dataclasses.replace(PAIRING, sigmas=sigmas))
    for length in (0.060, 0.061):
        pair = draw_pair(arc(length, 8.0, 0.3))
        measured = tracker.process(*pair, length if is_known else None)
    assert measured.tip is not None
    assert len(searched) == searches


def test_a_black_image_is_reported(tracker: NeedleTracker, draw_pair: Drawer) -> None:
    left, right = draw_pair(arc(0.05, 5.0, 1.0))
    for insertion in (0.001, 0.05, None):
        measured = tracker.process(left, np.zeros_like(right), insertion)
        assert measured.tip is None
        assert measured.reason == "right image is black"


def test_random_images_give_no_tip_and_no_error(tracker: NeedleTracker) -> None:
    rng = np.random.default_rng(9)
    for _ in range(8):
        pair = []
        for _ in range(2):
            image = rng.normal(rng.uniform(40, 200), rng.choice([0.0, 8.0, 40.0]), (768, 1024))
            for _ in range(4):
                u, v = rng.integers(0, 900), rng.integers(0, 700)
                width, height = rng.integers(2, 300, 2)
                image[v : v + height, u : u + width] = rng.uniform(0, 255)
            pair.append(np.clip(image, 0, 255).astype(np.uint8))
        assert tracker.process(pair[0], pair[1], float(rng.uniform(0.01, 0.2))).tip is None


def test_another_size_raises(tracker: NeedleTracker) -> None:
    small = np.zeros((480, 640), np.uint8)
    with pytest.raises(ValueError, match=r"left image is uint8\(480, 640\)"):
        tracker.process(small, small, None)
