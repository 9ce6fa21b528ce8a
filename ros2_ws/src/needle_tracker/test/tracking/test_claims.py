"""What tips claim beyond their fit: shares of the needle's width, seen through the window."""

from __future__ import annotations

import numpy as np
import pytest

from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.claims import OF_LAMP, OF_MAP, OF_OUTLINE, Claims, StagedEnd, Unseen
from needle_tracker.tracking.triangulation import SpatialTip, midpoint

WIDTH, WIDTHS_PX = 0.7e-3, (4.6, 5.1)
AHEAD = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
POSITION = np.array([0.4e-3, -1.0e-3, 0.06])
Views = tuple[RefractedCamera, RefractedCamera]


def tip(covariance: np.ndarray) -> SpatialTip:
    return SpatialTip(POSITION, covariance, AHEAD, np.eye(3) * 1e-4, 0.0, 0.0)


@pytest.mark.parametrize("unseen", [OF_OUTLINE, OF_LAMP, OF_MAP])
def test_what_is_added_is_what_noise_of_that_share_does(views: Views, unseen: Unseen) -> None:
    claims = Claims(views, WIDTHS_PX, WIDTH, 0.0)
    fit = np.diag([1e-10, 2e-10, 3e-10])
    added = claims.widened(tip(fit), unseen).covariance - fit
    assert float(AHEAD @ added @ AHEAD) == pytest.approx((unseen.along * WIDTH) ** 2, rel=1e-6)

    # Both lines moved aside in their images, by chance: where do they then meet?
    rng = np.random.default_rng(3)
    met = []
    for _ in range(4000):
        moved = []
        for view, width in zip(views, WIDTHS_PX, strict=True):
            ends = view.project(np.stack([POSITION, POSITION + 1e-4 * AHEAD]))
            line = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
            beside = np.array([-line[1], line[0]])
            moved.append(ends[0] + beside * rng.normal(0.0, unseen.across * width))
        met.append(midpoint(views, (moved[0], moved[1])) - POSITION)
    # Only what is across the shaft: how far along it rays pass each other closest means nothing.
    across_shaft = np.eye(3) - np.outer(AHEAD, AHEAD)
    seen = np.linalg.eigvalsh(across_shaft @ np.cov(np.array(met).T) @ across_shaft)[1:]
    claimed = np.linalg.eigvalsh(across_shaft @ added @ across_shaft)[1:]
    assert claimed == pytest.approx(seen, rel=0.35)


def test_a_known_face_bounds_what_it_may_hide_and_not_where_a_lamp_ends(views: Views) -> None:
    fit = np.diag([1e-10, 2e-10, 3e-10])
    face = 0.3e-3

    def added(unseen: Unseen, bevel_length: float) -> np.ndarray:
        claims = Claims(views, WIDTHS_PX, WIDTH, bevel_length)
        return np.asarray(claims.widened(tip(fit), unseen).covariance - fit)

    for unseen in (OF_OUTLINE, OF_MAP):
        known, unknown = added(unseen, face), added(unseen, 0.0)
        share = (unseen.along * WIDTH) ** 2
        expected = 1.0 / (1.0 / share + 12.0 / face**2)
        assert float(AHEAD @ known @ AHEAD) == pytest.approx(expected, rel=1e-6)
        # Across the shaft it says nothing.
        across = np.eye(3) - np.outer(AHEAD, AHEAD)
        np.testing.assert_allclose(across @ known @ across, across @ unknown @ across, atol=1e-18)
    assert np.array_equal(added(OF_LAMP, face), added(OF_LAMP, 0.0))


def test_a_tip_claims_no_more_than_its_fit(views: Views) -> None:
    loose = np.diag([1e-6, 1e-6, 4e-6])
    widened = Claims(views, WIDTHS_PX, WIDTH, 0.0).widened(tip(loose), OF_OUTLINE)
    assert np.linalg.eigvalsh(widened.covariance - loose).min() > 0.0
    assert widened.covariance == pytest.approx(loose, rel=0.1, abs=1e-7)
    assert np.array_equal(widened.position, POSITION)


def _along(sigma: float, short: float, length: float) -> SpatialTip:
    """Return a tip on the z axis that is seen so much short of a length [m]."""
    end = np.array([0.0, 0.0, length - short])
    covariance = np.diag([1e-10, 4e-10, sigma * sigma])
    return SpatialTip(end, covariance, np.array([0.0, 0.0, 1.0]), np.eye(3) * 1e-4, 0.0, 0.0)


def _shaft(length: float) -> np.ndarray:
    return np.linspace([0.0, 0.0, 5e-3], [0.0, 0.0, length], 11)


def test_an_end_that_is_seen_badly_lies_where_the_stage_has_it() -> None:
    staged = StagedEnd(0.25e-3, 2e-3)
    first = staged.placed(_along(0.4e-3, 0.4e-3, 0.05), _shaft(0.05), 0.05)
    # Weights are the inverse variances of a zero of 0.25 mm and an end of 0.4 mm.
    assert 0.05 - first.position[2] == pytest.approx(0.4e-3 * 25 / 89, rel=0.02)
    assert first.covariance[2, 2] == pytest.approx(1.0 / (0.25**-2 + 0.4**-2) * 1e-6, rel=0.01)
    np.testing.assert_allclose(first.covariance[:2, :2], np.diag([1e-10, 4e-10]))
    # Seen as badly ten times more, no more is known.
    for k in range(1, 11):
        length = 0.05 + 1e-3 * k
        later = staged.placed(_along(0.4e-3, 0.4e-3, length), None, length)
    assert 0.06 - later.position[2] == pytest.approx(0.4e-3 * 25 / 89, rel=0.05)
    assert later.covariance[2, 2] == pytest.approx(first.covariance[2, 2], rel=0.05)


def test_the_end_that_was_seen_best_says_where_the_stage_has_its_zero() -> None:
    staged = StagedEnd(0.25e-3, 2e-3)
    staged.placed(_along(0.02e-3, 0.9e-3, 0.05), _shaft(0.05), 0.05)
    hidden = staged.placed(_along(0.4e-3, 1.4e-3, 0.052), None, 0.052)
    assert 0.052 - hidden.position[2] == pytest.approx(0.9e-3, abs=0.02e-3)
    # One that is seen less well, but plainly farther out, shows that the first lay short.
    farther = staged.placed(_along(0.2e-3, 0.1e-3, 0.054), None, 0.054)
    assert 0.054 - farther.position[2] < 0.1e-3
    # The next run begins with another zero.
    staged.forget()
    other = staged.placed(_along(0.05e-3, 0.0, 0.05), _shaft(0.05), 0.05)
    assert other.position[2] == pytest.approx(0.05, abs=0.01e-3)


def test_without_stage_or_shaft_a_tip_stays_as_it_is() -> None:
    staged = StagedEnd(0.25e-3, 2e-3)
    seen = _along(0.4e-3, 0.4e-3, 0.05)
    assert staged.placed(seen, None, 0.05) is seen
    assert staged.placed(seen, _shaft(0.05), None) is seen


def test_a_shaft_that_the_stage_cannot_have_pushed_in_moves_no_tip() -> None:
    staged = StagedEnd(0.25e-3, 2e-3)
    seen = _along(0.3e-3, 0.0, 0.02)
    assert staged.placed(seen, _shaft(0.02), 0.008) is seen
    # Nothing of it is kept: the next that fits is the first.
    later = staged.placed(seen, _shaft(0.02), 0.02)
    assert later.position[2] == pytest.approx(0.02, abs=0.01e-3)
