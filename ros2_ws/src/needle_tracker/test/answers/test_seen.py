"""What each view shows, and what was missing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_tracker.answers.annotation import annotate, describe_view, missing
from needle_tracker.answers.run_summary import SeenCounts
from needle_tracker.answers.track_images import COLUMNS, to_row
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.filter.measurement import Measurement, NoTip, TrackState

END = ImageEnd(np.array([300.0, 200.0]), np.array([1.0, 0.0]), 0.3, 1.0, 0.01, 0.93, 0.98)
HIDDEN = dataclasses.replace(END, ends=0.2)


def nothing(left: ImageEnd | None, right: ImageEnd | None) -> Measurement:
    return Measurement(None, TrackState.SEARCHING, NoTip.NOTHING, (left, right))


@pytest.mark.parametrize(
    ("left", "right", "cause"),
    [
        (None, HIDDEN, "no needle seen"),
        (END, HIDDEN, "end seen in the left view only"),
        (None, END, "end seen in the right view only"),
        (END, END, "both views show an end but they do not meet"),
    ],
)
def test_the_reason_for_no_tip_depends_on_the_views(
    left: ImageEnd | None, right: ImageEnd | None, cause: str
) -> None:
    measured = nothing(left, right)
    assert missing(measured) == cause
    row = dict(zip(COLUMNS, to_row("a", measured), strict=True))
    assert (row["valid"], row["missing"]) == ("0", cause)
    seen = {None: ("", ""), END: ("0.93", "0.98"), HIDDEN: ("0.20", "0.98")}
    assert (row["left_end"], row["left_shaft"]) == seen[left]
    assert (row["right_end"], row["right_shaft"]) == seen[right]


def test_counts_include_all_processed_pairs() -> None:
    counts = SeenCounts()
    for measured in (
        *[nothing(END, HIDDEN)] * 3,
        Measurement(None, TrackState.CONFIRMING, NoTip.UNCONFIRMED, (END, END)),
        *[Measurement(None, TrackState.ENTRY, "")] * 5,
    ):
        counts.add(measured)
    said = counts.describe().splitlines()
    assert said[0].endswith("left : end seen in 4 of 4 pairs, shaft in 4")
    assert said[1].endswith("right: end seen in 1 of 4 pairs, shaft in 4")
    assert said[2].endswith("5 x  in the entry zone")
    assert counts.figures()["right_end_seen"] == 1


def test_pictures_describe_each_view() -> None:
    grey = np.full((480, 640), 128, np.uint8)
    assert (describe_view(None), describe_view(END)) == ("nothing found", "end 0.93, shaft 0.98")
    below = annotate(grey, grey, nothing(END, None))[240:262]
    other = annotate(grey, grey, nothing(END, END))[240:262]
    assert np.array_equal(below[:, :320], other[:, :320])
    assert not np.array_equal(below[:, 322:], other[:, 322:])
