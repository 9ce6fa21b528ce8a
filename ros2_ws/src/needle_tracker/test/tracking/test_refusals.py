"""Reasons why a pair gives no tip."""

from __future__ import annotations

from needle_tracker.tracking.refusals import NoTip, progress


def test_reasons_are_in_the_order_in_which_a_pair_meets_them() -> None:
    met = [
        "no needle in the right image",
        "no clear tip in the left image",
        NoTip.NO_COMMON_POINT,
        NoTip.DISAGREE_ALONG,
        NoTip.SHORT_OF_INSERTION,
        "the shaft's length is not the insertion",
        NoTip.UNCLEAR,
        NoTip.UNCONFIRMED,
        NoTip.STANDS,
    ]
    ranks = [progress(str(reason)) for reason in met]
    assert ranks == sorted(set(ranks))
