"""Pairing of images by stamp, and interpolation of the insertion between joint states."""

from __future__ import annotations

import math

import pytest

from needle_tracker.sources.pairing import InsertionHistory, PairMatcher


def test_equal_stamps_pair_in_any_order_of_arrival() -> None:
    matcher: PairMatcher[str] = PairMatcher(0)
    assert matcher.add("left", 10, "l10") is None
    assert matcher.add("left", 20, "l20") is None
    pair = matcher.add("right", 10, "r10")
    assert pair is not None
    assert (pair.stamp, pair.left, pair.right) == (10, "l10", "r10")
    pair = matcher.add("right", 20, "r20")
    assert pair is not None
    assert (pair.stamp, pair.left, pair.right) == (20, "l20", "r20")
    assert (matcher.pairs, matcher.unpaired.total()) == (2, 0)


def test_latest_is_never_paired_with_latest_and_dropped_images_are_counted() -> None:
    matcher: PairMatcher[str] = PairMatcher(0)
    matcher.add("left", 10, "l10")
    assert matcher.add("right", 20, "r20") is None
    assert matcher.add("left", 21, "l21") is None
    assert matcher.pairs == 0
    assert matcher.add("right", 21, "r21") is not None
    assert matcher.unpaired == {"left": 1, "right": 1}
    assert matcher.add("right", 10, "r10") is None
    # Images of one camera alone do not accumulate.
    for stamp in range(100, 200):
        assert matcher.add("right", stamp, "r") is None
    assert len(matcher.waiting("right")) == 3
    assert matcher.unpaired["right"] == 99


def test_tolerance_is_kept_and_the_nearest_wins() -> None:
    matcher: PairMatcher[str] = PairMatcher(5)
    matcher.add("left", 100, "l100")
    assert matcher.add("right", 106, "r106") is None
    pair = matcher.add("left", 104, "l104")
    assert pair is not None
    assert (pair.stamp, pair.left, pair.right) == (104, "l104", "r106")
    assert matcher.unpaired["left"] == 1


def test_free_running_cameras_pair_within_half_a_frame_and_the_skew_is_reported() -> None:
    matcher: PairMatcher[str] = PairMatcher(None)
    period, late, pairs = 33_000, 12_000, []
    for number in range(40):
        jitter = 1_000 * (number % 3)
        for side, stamp in (("left", number * period), ("right", number * period + late + jitter)):
            pair = matcher.add(side, stamp, f"{side[0]}{number}")
            if pair is not None:
                pairs.append(pair)
    # Until the period is known, nothing pairs; then each image pairs with the nearest one.
    assert len(pairs) >= 37
    assert all(pair.left[1:] == pair.right[1:] for pair in pairs)
    median, largest = matcher.skew or (0.0, 0)
    assert (median, largest) == (late + 1_000.0, late + 2_000)
    assert matcher.tolerance == period // 2
    # A frame without a partner within half a period has no pair.
    assert matcher.add("left", 40 * period, "l40") is None
    assert matcher.add("right", 40 * period + 20_000, "r40") is None


def test_insertion_is_interpolated_at_the_exposure() -> None:
    history = InsertionHistory()
    assert history.latest < 0
    history.add(100, 0.010)
    assert history.latest == 100
    assert history.at(101) is None
    history.add(200, 0.020)
    for stamp, insertion in ((99, None), (100, 0.010), (130, 0.013), (200, 0.020)):
        assert history.at(stamp) == (insertion and pytest.approx(insertion))
    # The later of two equal stamps counts; a non-finite value does not.
    history.add(200, 0.030)
    history.add(210, math.nan)
    assert (history.at(200), history.rejected, history.latest) == (0.030, 1, 200)
    history.add(50, 0.002)
    assert (history.restarts, history.at(100), history.at(50)) == (1, None, 0.002)
    assert (history.time_before(49), history.time_before(50)) == (1, 0)
