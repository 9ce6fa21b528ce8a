"""Which of the two ways to look counts: on drawn needles, and with trackers told what to say."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from needle_tracker.image.detection import Image
from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.optics.calibration import StereoCalibration
from needle_tracker.tracking.measurement import Measurement
from needle_tracker.tracking.refusals import NoTip, TrackState
from needle_tracker.tracking.tip_tracker import TipTracker
from needle_tracker.tracking.tracker import StereoTracker
from needle_tracker.tracking.tracker_settings import TrackerSettings
from needle_tracker.tracking.triangulation import SpatialTip

Drawer = Callable[..., tuple[np.ndarray, np.ndarray]]
MakeArc = Callable[..., np.ndarray]
NOTHING = np.zeros((768, 1024), np.uint8)


def test_a_plain_needle_is_measured_by_its_lines(
    calibration: StereoCalibration,
    settings: TrackerSettings,
    draw_pair: Drawer,
    make_arc: MakeArc,
) -> None:
    lines, both = StereoTracker(calibration, settings), TipTracker(calibration, settings)
    for mm in range(70, 74):
        pair = draw_pair(make_arc(1e-3 * mm, 5.0, 0.4), mm)
        alone, together = (each.process(*pair, 1e-3 * mm) for each in (lines, both))
        assert alone.tip is not None
        assert together.tip is not None
        assert np.array_equal(alone.tip.position, together.tip.position)


class Told:
    """A tracker that says what it is told, and counts how often it is asked."""

    def __init__(self) -> None:
        self.tip: SpatialTip | None = None
        self.reason = ""
        self.why = "no needle"
        self.state = TrackState.SEARCHING
        self.ends: tuple[ImageTip | None, ImageTip | None] = (None, None)
        self.asked = 0

    def process(self, _: Image, __: Image, ___: float | None) -> Measurement:
        self.asked += 1
        reason = self.reason if self.tip else self.why
        return Measurement(self.tip, self.state, reason, self.ends)

    def skip(self, reason: str) -> Measurement:
        return Measurement(None, TrackState.SEARCHING, reason)

    def reset(self) -> None:
        self.tip = None


@pytest.fixture
def some_end() -> ImageTip:
    """Return a dark end that any fit could have found."""
    return ImageTip(
        point=np.array([500.0, 400.0]),
        direction=np.array([1.0, 0.0]),
        sigma_across=0.1,
        sigma_along=0.3,
        sigma_angle=0.01,
        contrast=80.0,
        visibility=0.6,
        clear=True,
    )


@pytest.fixture
def told(
    calibration: StereoCalibration, settings: TrackerSettings
) -> tuple[TipTracker, Told, Told]:
    tracker = TipTracker(calibration, settings)
    lines, maps = Told(), Told()
    tracker._lines, tracker._maps = lines, maps  # type: ignore[assignment]
    return tracker, lines, maps


def tip_at(z: float, sigma: float) -> SpatialTip:
    covariance = np.diag([1e-9, 1e-9, sigma**2])
    ahead = np.array([0.0, 0.0, 1.0])
    return SpatialTip(np.array([0.0, 0.0, z]), covariance, ahead, np.eye(3) * 1e-4, 0.0, 0.0)


def answer(tracker: TipTracker) -> SpatialTip | None:
    tip = tracker.process(NOTHING, NOTHING, 0.06).tip
    tracker.catch_up()
    return tip


def counts(tracker: TipTracker, told: Told) -> bool:
    """Return whether the tip of the next pair is the one that was told."""
    tip = answer(tracker)
    return tip is not None and told.tip is not None and tip.position is told.tip.position


def test_lines_count_while_maps_agree_and_are_seldom_asked(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, lines, maps = told
    lines.tip, maps.tip = tip_at(0.0600, 2e-5), tip_at(0.0601, 2e-4)
    assert all(counts(tracker, lines) for _ in range(30))
    assert 3 <= maps.asked <= 4


def test_no_answer_waits_for_maps_that_cannot_change_it(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, lines, maps = told
    lines.tip, maps.tip = tip_at(0.0600, 2e-5), tip_at(0.0601, 2e-4)
    # Nobody has asked the maps yet: they may deny the lines.
    tracker.process(NOTHING, NOTHING, 0.06)
    assert maps.asked == 1
    for _ in range(30):
        asked = maps.asked
        tracker.process(NOTHING, NOTHING, 0.06)
        assert maps.asked == asked
        tracker.catch_up()
    assert maps.asked == 4


class Script(Told):
    """A tracker that says of each pair, by its insertion in mm, what is written for it."""

    def __init__(self, tips: list[SpatialTip | None]) -> None:
        super().__init__()
        self._tips = tips

    def process(self, _: Image, __: Image, insertion: float | None) -> Measurement:
        assert insertion is not None
        tip = self._tips[round(1e3 * insertion) - FIRST_MM]
        return Measurement(tip, self.state, "" if tip else "no needle")


FIRST_MM = 10


class Waiting(TipTracker):
    """A tracker whose every answer waits for the maps."""

    def _lines_count_anyhow(self, _: Measurement) -> bool:
        return False


@pytest.mark.parametrize("seed", range(2))
def test_maps_drawn_after_an_answer_change_no_answer(
    calibration: StereoCalibration, settings: TrackerSettings, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    sayings: list[SpatialTip | None] = [tip_at(0.0600, 2e-5), tip_at(0.0590, 2e-5), None]
    scripts: tuple[list[SpatialTip | None], ...] = ([], [])
    for script in scripts:
        # For a while the same, as needles are.
        while len(script) < 400:
            saying = sayings[rng.choice(3, p=(0.6, 0.3, 0.1))]
            script.extend([saying] * int(rng.integers(1, 40)))
    said: list[list[tuple[float, float] | None]] = []
    for kind, catches_up in ((Waiting, 0.0), (TipTracker, 0.0), (TipTracker, 0.5)):
        tracker = kind(calibration, settings)
        tracker._lines, tracker._maps = map(Script, scripts)  # type: ignore[assignment]
        said.append([])
        for pair in range(400):
            tip = tracker.process(NOTHING, NOTHING, 1e-3 * (FIRST_MM + pair)).tip
            said[-1].append(None if tip is None else (tip.position[2], tip.covariance[2, 2]))
            if rng.random() < catches_up:
                tracker.catch_up()
    assert said[1] == said[0]
    assert said[2] == said[0]
    assert len(set(said[0])) > 2


def test_an_end_that_maps_deny_does_not_count(told: tuple[TipTracker, Told, Told]) -> None:
    tracker, lines, maps = told
    lines.tip, maps.tip = tip_at(0.0590, 2e-5), tip_at(0.0600, 2e-4)
    assert all(counts(tracker, maps) for _ in range(30))
    # The finer one counts again when they have agreed three times in a row.
    lines.tip = tip_at(0.0601, 2e-5)
    assert [counts(tracker, lines) for _ in range(4)] == [False, False, True, True]


def test_what_maps_have_of_one_view_denies_no_lines_of_both(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, lines, maps = told
    lines.tip, maps.tip = tip_at(0.0590, 2e-5), tip_at(0.0600, 2e-4)
    maps.reason = "one view alone, too uncertain"
    assert counts(tracker, lines)
    lines.tip = None
    assert counts(tracker, maps)
    # Though maps count now.
    lines.tip = tip_at(0.0590, 2e-5)
    assert counts(tracker, lines)


def test_lines_that_agreed_with_maps_are_denied_three_times_before_they_give_way(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, lines, maps = told
    lines.tip, maps.tip = tip_at(0.0600, 2e-5), tip_at(0.0601, 2e-4)
    assert counts(tracker, lines)
    # A glint over the end misleads the maps for two pairs.
    maps.tip = tip_at(0.0585, 2e-4)
    asked = maps.asked
    while maps.asked < asked + 2:
        assert counts(tracker, lines)
    maps.tip = tip_at(0.0601, 2e-4)
    assert counts(tracker, lines)
    # A shadow that stays does not.
    lines.tip = tip_at(0.0590, 2e-5)
    asked = maps.asked
    seen = [counts(tracker, maps) for _ in range(14)]
    assert seen[-1]
    assert seen.index(True) + 1 <= 12
    assert seen[seen.index(True) :] == [True] * (14 - seen.index(True))


def test_what_may_be_a_mirrored_lamp_gives_way_to_maps_that_agree(
    told: tuple[TipTracker, Told, Told], some_end: ImageTip
) -> None:
    tracker, lines, maps = told
    lines.tip, maps.tip = tip_at(0.0600, 2e-5), tip_at(0.0601, 2e-4)
    lines.ends = (some_end, dataclasses.replace(some_end, bright=True))
    assert all(counts(tracker, maps) for _ in range(5))
    maps.tip = None
    widened = answer(tracker)
    assert widened is not None
    assert math.sqrt(widened.covariance[2, 2]) >= tracker.settings.needle_width


def test_a_needle_that_is_said_to_be_bright_is_no_lamp(
    calibration: StereoCalibration, settings: TrackerSettings, some_end: ImageTip
) -> None:
    tracker = TipTracker(calibration, dataclasses.replace(settings, bright=True))
    lines, maps = Told(), Told()
    tracker._lines, tracker._maps = lines, maps  # type: ignore[assignment]
    lines.tip, maps.tip = tip_at(0.0600, 2e-5), tip_at(0.0601, 2e-4)
    lines.ends = (dataclasses.replace(some_end, bright=True),) * 2
    assert counts(tracker, lines)


def test_maps_are_compared_as_soon_as_they_show_a_needle(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, lines, maps = told
    lines.tip = tip_at(0.0590, 2e-5)
    assert counts(tracker, lines)
    maps.tip = tip_at(0.0600, 2e-4)
    assert counts(tracker, maps)


def test_the_other_answers_where_one_is_silent(told: tuple[TipTracker, Told, Told]) -> None:
    tracker, lines, maps = told
    maps.tip = tip_at(0.06, 2e-4)
    assert counts(tracker, maps)
    maps.tip, lines.tip = None, tip_at(0.06, 2e-5)
    assert counts(tracker, lines)
    lines.tip = None
    assert answer(tracker) is None


def test_maps_that_show_nothing_are_drawn_of_every_third_pair(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, lines, maps = told
    for _ in range(35):
        assert answer(tracker) is None
    assert lines.asked == 35
    assert maps.asked == 5 + 30 // 3
    maps.tip = tip_at(0.06, 2e-4)
    assert any(counts(tracker, maps) for _ in range(3))


def test_maps_that_show_something_are_drawn_until_it_is_confirmed(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, _, maps = told
    for _ in range(30):
        assert answer(tracker) is None
    maps.state, before = TrackState.CONFIRMING, maps.asked
    for _ in range(6):
        assert answer(tracker) is None
    assert maps.asked >= before + 4


def test_the_reason_is_that_of_whichever_got_farther(
    told: tuple[TipTracker, Told, Told],
) -> None:
    tracker, lines, maps = told

    def reason() -> str:
        return tracker.process(NOTHING, NOTHING, None).reason

    lines.why, maps.why = "no needle in the left image", NoTip.UNCONFIRMED
    assert reason() == "not confirmed yet"
    lines.why = NoTip.STANDS
    assert reason() == "not moved yet"
    # While maps rest, what they said last is said of what lines do not see.
    lines.why, maps.why = "no clear tip in the left image", NoTip.STANDS
    for _ in range(20):
        assert reason() == "not moved yet"
    assert maps.asked < 20
    maps.why = "no needle in the right image"
    for _ in range(3):
        reason()
    assert reason() == "no clear tip in the left image"


def test_a_new_insertion_begins_with_lines(
    told: tuple[TipTracker, Told, Told], settings: TrackerSettings
) -> None:
    tracker, lines, maps = told
    maps.tip = tip_at(0.06, 2e-4)
    assert counts(tracker, maps)
    entering = 0.5 * settings.entry_zone
    lines.tip = dataclasses.replace(tip_at(entering, 1e-3))
    assert tracker.process(NOTHING, NOTHING, entering).tip is lines.tip
    assert not tracker._maps_count
