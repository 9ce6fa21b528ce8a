"""Tip in space from two image tips: exact without noise, consistent with noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.stereo.triangulation import locate, triangulate

Views = tuple[RefractedCamera, RefractedCamera]
TIP = np.array([-0.004, 0.006, 0.08])
START = TIP + np.array([3e-3, -2e-3, 4e-3])
HEADING = np.array([0.08, -0.3, 0.95]) / np.linalg.norm([0.08, -0.3, 0.95])


def image_ends(
    views: Views, tip: np.ndarray = TIP, heading: np.ndarray = HEADING
) -> list[ImageEnd]:
    tips = []
    for view in views:
        ahead, behind = view.project(np.stack([tip + 5e-5 * heading, tip - 5e-5 * heading]))
        direction = (ahead - behind) / np.linalg.norm(ahead - behind)
        tips.append(ImageEnd(view.project(tip), direction, 0.05, 0.5, 2e-3, 1.0, 1.0))
    return tips


def test_exact_images_give_the_exact_tip(views: Views) -> None:
    left, right = image_ends(views)
    tip = triangulate(views, (left, right), START)
    assert tip is not None
    np.testing.assert_allclose(tip.position, TIP, atol=1e-11)
    np.testing.assert_allclose(tip.direction, HEADING, atol=1e-5)
    assert tip.misfit < 1e-9


def test_shafts_in_opposite_directions_are_not_one_needle(views: Views) -> None:
    left, right = image_ends(views)
    for one, other in ((left, turned(right)), (turned(left), right)):
        assert triangulate(views, (one, other), START) is None


def turned(tip: ImageEnd) -> ImageEnd:
    return dataclasses.replace(tip, direction=-tip.direction)


def moved(tip: ImageEnd, along: float, across: float, turn: float) -> ImageEnd:
    normal = np.array([-tip.direction[1], tip.direction[0]])
    direction = tip.direction + turn * normal
    return dataclasses.replace(
        tip,
        point=tip.point + along * tip.direction + across * normal,
        direction=direction / np.linalg.norm(direction),
    )


def measured(tip: ImageEnd, rng: np.random.Generator) -> ImageEnd:
    """Return an end with random errors as it claims."""
    return moved(tip, rng.normal(0, 0.5), rng.normal(0, 0.05), rng.normal(0, 2e-3))


def test_covariances_fit_the_errors(views: Views) -> None:
    rng = np.random.default_rng(0)
    exact = image_ends(views)
    errors, plain, turns = [], [], []
    squared = []
    for _ in range(400):
        left, right = (measured(tip, rng) for tip in exact)
        tip = triangulate(views, (left, right), START)
        assert tip is not None
        error = tip.position - TIP
        errors.append(error)
        squared.append(error @ np.linalg.solve(tip.covariance, error))
        equal = locate(views, np.stack([left.point, right.point]), START)
        assert equal is not None
        plain.append(equal[0] - TIP)
        turns.append(tip.direction - HEADING)
    # chi^2 of 3 degrees, mean of 400: 3 +- 4 sigma.
    assert 2.5 < np.mean(squared) < 3.5
    spread, tip = np.cov(np.transpose(turns)), triangulate(views, (exact[0], exact[1]), START)
    assert tip is not None
    np.testing.assert_allclose(
        np.sqrt(np.diag(tip.direction_covariance)), np.sqrt(np.diag(spread)), rtol=0.2, atol=1e-4
    )
    assert abs(tip.direction @ tip.direction_covariance @ tip.direction) < 1e-12
    # The poorly measured position along the needle does not spoil the depth.
    assert np.std(np.array(errors)[:, 0]) < 0.6 * np.std(np.array(plain)[:, 0])


def test_the_covariance_of_the_direction_agrees_with_finite_differences(views: Views) -> None:
    sigmas, turn = (1e-3, 6e-3), 1e-4
    exact = [
        dataclasses.replace(tip, sigma_angle=sigma)
        for tip, sigma in zip(image_ends(views), sigmas, strict=True)
    ]
    expected = np.zeros((3, 3))
    for i, sigma in enumerate(sigmas):
        directions = []
        for sign in (1.0, -1.0):
            tips = [moved(tip, 0, 0, sign * turn if k == i else 0) for k, tip in enumerate(exact)]
            tip = triangulate(views, (tips[0], tips[1]), START)
            assert tip is not None
            directions.append(tip.direction)
        slope = (directions[0] - directions[1]) / (2.0 * turn)
        expected += sigma**2 * np.outer(slope, slope)
    tip = triangulate(views, (exact[0], exact[1]), START)
    assert tip is not None
    np.testing.assert_allclose(
        tip.direction_covariance, expected, rtol=0.0, atol=1e-4 * np.trace(expected)
    )


def test_the_misfit_of_two_ends_of_one_needle_is_chi_squared(views: Views) -> None:
    rng = np.random.default_rng(1)
    exact, misfits = image_ends(views), []
    for _ in range(400):
        left, right = (measured(tip, rng) for tip in exact)
        tip = triangulate(views, (left, right), START)
        assert tip is not None
        misfits.append(tip.misfit)
    # One degree of freedom: mean 1, and 5 % above 3.84.
    assert 0.75 < np.mean(misfits) < 1.25
    assert 0.02 < np.mean(np.array(misfits) > 3.84) < 0.09
    apart = triangulate(views, (exact[0], moved(exact[1], -10.0, 0.0, 0.0)), START)
    assert apart is not None
    assert apart.misfit > 25.0


def test_a_needle_along_the_baseline_has_no_direction(views: Views) -> None:
    across = np.array([0.0, 1.0, 0.0])
    tips = image_ends(views, np.array([0.0, 0.0, 0.0625]), across)
    tip = triangulate(views, (tips[0], tips[1]), START)
    assert tip is None or tip.direction_covariance.trace() > 1e-3
    # However certain the lines are, residual calibration errors would determine the direction.
    tips = image_ends(views, np.array([0.0, 0.0, 0.0625]), across + np.array([0.0, 0.0, 1e-3]))
    left, right = (dataclasses.replace(tip, sigma_angle=1e-9) for tip in tips)
    assert triangulate(views, (left, right), START) is None


@pytest.mark.parametrize("gap", [400.0, 3000.0])
def test_views_that_do_not_meet_in_the_phantom_do_not_pass_silently(
    views: Views, gap: float
) -> None:
    left, right = image_ends(views)
    tip = triangulate(views, (left, moved(right, 0.0, gap, 0.0)), START)
    assert tip is None or abs(tip.position[0] - TIP[0]) > 0.02
