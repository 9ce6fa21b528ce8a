"""Updates by one tip: uniform and normal noise, outliers, and what a tip shows of the noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal, norm

from needle_controller.bank.estimate_tiles import (
    E_KAPPA,
    E_SCALE,
    ERROR,
    EVIDENCE,
    KAPPA,
    NOISE,
    NOISES,
    OUTLIER,
    PAIRS,
    PLAY,
    REMAINDER,
    ROWS,
    SCALE,
    SHAPE,
    WEIGHT,
    P,
    R,
    Tiles,
    X,
    covariances,
    lower_half,
    rows,
    set_rows,
    tiles_of,
)
from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypotheses import LASTING, NoiseHypothesis
from needle_controller.bank.hypothesis_filter import readings
from needle_controller.bank.tip_update import UPDATE_ROWS, rotate, take_tip
from needle_controller.model.arrays import Array

SCALES = np.array([3e-4, 3e-4, 3e-4, 0.1, 0.1, 0.3, 1.0, 0.1, 0.05])
COUNT = 8
BOUND = 0.001
MIDDLE = np.array([0.01, 0.02, 0.03])
PLAIN = FilterSettings(
    softness=0.0, mistrust=0.0, outlier_share=1e-6, curvature_range=(0.01, 100.0)
)
LASTS = dataclasses.replace(
    PLAIN,
    model_error=0.0,
    noise_hypotheses=(NoiseHypothesis(LASTING, (1.0,), (1.0,), 1.0, (0.6,)),),
)
WITH_OUTLIERS = FilterSettings(softness=0.0, mistrust=0.0)


def estimates(covariance: Array | None = None, *, is_uniform: bool = False, seed: int = 3) -> Tiles:
    """Eight estimates about `MIDDLE`, by default none like another; noise is as claimed."""
    rng = np.random.default_rng(seed)
    numbers = np.zeros((COUNT, ROWS))
    numbers[:, X : X + 3] = MIDDLE
    numbers[:, R : R + 9] = Rotation.random(COUNT, random_state=seed).as_matrix().reshape(-1, 9)
    if covariance is None:
        numbers[:, X : X + 3] += rng.normal(0.0, 1e-3, (COUNT, 3))
        factor = rng.normal(size=(COUNT, ERROR, ERROR)) * SCALES[:, None]
        covariance = factor @ np.swapaxes(factor, -1, -2)
    numbers[:, P : P + PAIRS] = lower_half(np.broadcast_to(covariance, (COUNT, ERROR, ERROR)))
    numbers[:, KAPPA], numbers[:, SCALE], numbers[:, PLAY] = 8.0, 1.0, 0.5
    numbers[:, WEIGHT] = numbers[:, NOISE] = 1.0
    numbers[:, SHAPE] = is_uniform
    return tiles_of(numbers, np.array([COUNT]))


def taken(
    tiles: Tiles,
    tip: Array,
    noise: Array = np.eye(3) * BOUND**2 / 3.0,  # noqa: B008
    settings: FilterSettings = PLAIN,
) -> Tiles:
    tiles = tiles._replace(state=tiles.state.copy())
    lanes = tiles.state.shape[2]
    seen = np.repeat(readings(np.asarray(tip)[None], noise[None]), lanes, axis=0)
    take_tip(
        tiles.state[0],
        np.ascontiguousarray(seen.T),
        settings.noises(),
        settings.limits(),
        np.empty((UPDATE_ROWS, lanes)),
    )
    return tiles


def orientations(tiles: Tiles) -> Array:
    return np.asarray(rows(tiles, R, 9).reshape(-1, 3, 3))


def changes(before: Tiles, after: Tiles) -> Array:
    """What was added to the error's nine elements, (COUNT, 9)."""
    turned = orientations(after) @ np.swapaxes(orientations(before), -1, -2)
    added = rows(after, 0, ROWS) - rows(before, 0, ROWS)
    turn = Rotation.from_matrix(turned).as_rotvec()
    return np.column_stack([added[:, X : X + 3], turn, added[:, [KAPPA, PLAY, SCALE]]])


def test_uniform_noise_gives_the_posteriors_moments() -> None:
    """Against samples of the prior, those in the box kept; one coordinate measured."""
    rng = np.random.default_rng(4)
    covariance = np.zeros((ERROR, ERROR))
    used = [0, 4, E_KAPPA, E_SCALE]
    covariance[np.ix_(used, used)] = [
        [2.5e-7, 3e-5, 2e-4, 1e-5],
        [3e-5, 0.01, 0.02, 1e-3],
        [2e-4, 0.02, 1.0, 0.0],
        [1e-5, 1e-3, 0.0, 0.01],
    ]
    covariance[1, 1] = covariance[2, 2] = 1e-12
    samples = rng.multivariate_normal(np.zeros(ERROR), covariance, 400_000)
    before = estimates(covariance, is_uniform=True)
    kept = samples[np.abs(samples[:, 0] - 0.0012) <= BOUND]
    after = taken(before, MIDDLE + np.array([0.0012, 0.0, 0.0]))
    np.testing.assert_allclose(rows(after, EVIDENCE, 1), len(kept) / len(samples), rtol=0.02)
    deviation = np.sqrt(np.diag(np.cov(kept.T)))[used]
    found = changes(before, after)[2, used]
    np.testing.assert_allclose(found / deviation, kept.mean(axis=0)[used] / deviation, atol=0.02)
    np.testing.assert_allclose(
        covariances(after)[2][np.ix_(used, used)] / np.outer(deviation, deviation),
        np.cov(kept.T)[np.ix_(used, used)] / np.outer(deviation, deviation),
        atol=0.02,
    )


CORRELATED = np.array([[4e-7, 1e-7, 0.0], [1e-7, 9e-7, -2e-7], [0.0, -2e-7, 2.5e-7]])


def test_normal_noise_gives_kalmans_update() -> None:
    before = estimates()
    tip = np.array([0.0105, 0.0193, 0.031])
    after = taken(before, tip, CORRELATED)
    measured = np.eye(ERROR)[:3]
    found = changes(before, after)
    for h in range(COUNT):
        covariance, expected = covariances(before)[h], rows(before, X, 3)[h]
        spread = measured @ covariance @ measured.T + CORRELATED
        gain = covariance @ measured.T @ np.linalg.inv(spread)
        wanted = gain @ (tip - expected)
        np.testing.assert_allclose(found[h, :7], wanted[:7], rtol=1e-4, atol=1e-8)
        keep = np.eye(ERROR) - gain @ measured
        wanted = keep @ covariance @ keep.T + gain @ CORRELATED @ gain.T
        scale = np.outer(np.sqrt(np.diag(wanted)), np.sqrt(np.diag(wanted)))
        np.testing.assert_allclose(covariances(after)[h] / scale, wanted / scale, atol=2e-4)
        # Relative to the density of uniform noise of the same variances.
        density = multivariate_normal(expected, spread).pdf(tip)
        in_box = 1.0 / np.sqrt(12.0**3 * np.linalg.det(CORRELATED))
        assert rows(after, EVIDENCE, 1)[h, 0] == pytest.approx(density / in_box, rel=1e-4)


def with_lasting_noise(tiles: Tiles, shares: tuple[float, ...]) -> Tiles:
    set_rows(tiles, SHAPE, np.full((COUNT, 1), float(LASTING)))
    each = np.zeros(NOISES)
    each[: len(shares)] = shares
    set_rows(tiles, NOISE, np.tile(each, (COUNT, 3)))
    return tiles


def test_errors_that_last_are_told_from_the_estimates_own() -> None:
    """Against a Kalman filter whose state has the tip's error, too."""
    known = np.array([2e-4, 4e-4, 5e-4]) ** 2
    before = with_lasting_noise(estimates(np.diag([*known, *SCALES[3:] ** 2])), (1.0,))
    rest = np.array([7e-4, -2e-4, 1e-4])
    set_rows(before, REMAINDER, np.tile(rest, (COUNT, 1)))
    off = np.array([1e-3, 3e-4, -8e-4])
    after = taken(before, MIDDLE + off, settings=LASTS)
    likelihood = 1.0
    for axis in range(3):
        # What the estimate is off, and the tip's error; at the tip before their sum was seen.
        mean = np.array([0.0, 0.6 * rest[axis]])
        covariance = known[axis] * np.array([[1.0, -0.6], [-0.6, 0.36]])
        covariance[1, 1] += (1.0 - 0.6**2) * BOUND**2 / 3.0
        variance = covariance.sum()
        gain = covariance.sum(axis=1) / variance
        innovation = off[axis] - mean.sum()
        wanted = mean + gain * innovation
        np.testing.assert_allclose(changes(before, after)[:, axis], wanted[0], rtol=1e-4)
        np.testing.assert_allclose(rows(after, REMAINDER + axis, 1), wanted[1], rtol=1e-4)
        np.testing.assert_allclose(
            covariances(after)[:, axis, axis],
            covariance[0, 0] - gain[0] ** 2 * variance,
            rtol=1e-4,
        )
        likelihood *= 2.0 * BOUND * norm.pdf(innovation, scale=np.sqrt(variance))
    np.testing.assert_allclose(rows(after, EVIDENCE, 1), likelihood, rtol=1e-4)


def test_where_nothing_was_known_before_no_error_is_taken_off() -> None:
    before = with_lasting_noise(estimates(np.eye(ERROR) * 0.02**2), (1.0,))
    after = taken(before, MIDDLE + 0.01, settings=LASTS)
    np.testing.assert_allclose(changes(before, after)[:, :3], 0.01, rtol=0.005)


def test_tips_show_which_coordinate_is_noisier() -> None:
    noise = NoiseHypothesis(LASTING, (1.0, 2.0), (0.5, 0.5), 1.0, (0.0, 0.0))
    settings = dataclasses.replace(PLAIN, noise_hypotheses=(noise,))
    tiles = with_lasting_noise(estimates(np.eye(ERROR) * 1e-10), (0.5, 0.5))
    rng = np.random.default_rng(5)
    for _ in range(60):
        off = rng.normal(size=3) * [2.0, 1.0, 0.3] * BOUND / np.sqrt(3.0)
        tiles = with_state_of(taken(tiles, MIDDLE + off, settings=settings), before=tiles)
    likely = rows(tiles, NOISE, 3 * NOISES).reshape(COUNT, 3, NOISES)
    assert np.all(likely[:, 0, 1] > 0.9)
    assert np.all(likely[:, 1:, 0] > 0.9)


def with_state_of(after: Tiles, before: Tiles) -> Tiles:
    """What was learned of the noise, with the estimates as they were."""
    learned = rows(after, NOISE, 3 * NOISES)
    tiles = before._replace(state=before.state.copy())
    set_rows(tiles, NOISE, learned)
    return tiles


def test_an_exact_tip_is_taken() -> None:
    after = taken(estimates(), MIDDLE, np.zeros((3, 3)))
    assert np.all(np.isfinite(rows(after, 0, ROWS)))


@pytest.mark.parametrize("is_uniform", [False, True])
def test_an_outlier_changes_nothing(is_uniform: bool) -> None:
    before = estimates(np.diag((SCALES * 0.3) ** 2), is_uniform=is_uniform)
    after = taken(before, MIDDLE + np.array([0.01, 0.0, 0.0]), settings=WITH_OUTLIERS)
    np.testing.assert_allclose(rows(after, OUTLIER, 1), 1.0, atol=1e-3)
    np.testing.assert_allclose(changes(before, after), 0.0, atol=1e-6)
    np.testing.assert_allclose(covariances(after), covariances(before), rtol=1e-2)


def test_a_doubtful_tip_gives_the_mixtures_moments() -> None:
    """Half an outlier: the covariance of what was and of what would be, about their mean."""
    before = estimates(np.diag((SCALES * 0.3) ** 2))
    tip = MIDDLE + np.array([0.0022, 0.0, 0.0])
    whole, after = taken(before, tip), taken(before, tip, settings=WITH_OUTLIERS)
    share = rows(after, OUTLIER, 1)[0, 0]
    assert 0.1 < share < 0.9
    change = changes(before, whole)[0]
    np.testing.assert_allclose(changes(before, after)[0], (1.0 - share) * change, atol=1e-7)
    wanted = share * covariances(before)[0] + (1.0 - share) * covariances(whole)[0]
    wanted += share * (1.0 - share) * np.outer(change, change)
    np.testing.assert_allclose(np.diag(covariances(after)[0]), np.diag(wanted), rtol=1e-4)


def test_no_tip_changes_nothing() -> None:
    before = estimates()
    after = taken(before, np.full(3, np.nan), settings=WITH_OUTLIERS)
    same = [row for row in range(ROWS) if row not in {EVIDENCE, OUTLIER}]
    # A turn by nothing may round.
    np.testing.assert_allclose(
        rows(after, 0, ROWS)[:, same], rows(before, 0, ROWS)[:, same], rtol=1e-14
    )


@pytest.mark.parametrize("is_uniform", [False, True])
def test_tips_show_how_large_the_noise_is(is_uniform: bool) -> None:
    settings = FilterSettings()
    tiles = estimates(np.diag((SCALES * 0.1) ** 2), is_uniform=is_uniform)
    shares = settings.noises()[int(is_uniform), 1]
    set_rows(tiles, NOISE, np.tile(shares, (COUNT, 1)))
    rng, true = np.random.default_rng(8), 1.6
    for _ in range(30):
        noise = rng.uniform(-1, 1, 3) if is_uniform else rng.normal(0, 1 / np.sqrt(3.0), 3)
        tiles = taken(tiles, MIDDLE + true * BOUND * noise, settings=settings)
    multiples = settings.noises()[int(is_uniform), 0]
    likeliest = multiples[np.argmax(rows(tiles, NOISE, NOISES)[0])]
    assert likeliest == min(m for m in multiples if m >= true)
    np.testing.assert_allclose(np.sum(rows(tiles, NOISE, NOISES), axis=1), 1.0)


def test_rotate_turns_about_the_frames_axes_but_not_too_far() -> None:
    tiles = estimates()
    for vector, turned in (([0.3, -0.2, 0.5], 1.0), ([0.0, 3.0, 0.0], 0.5)):
        after = tiles._replace(state=tiles.state.copy())
        rotate(after.state[0], 4, *vector)
        wanted = Rotation.from_rotvec(np.array(vector) * turned).as_matrix()
        np.testing.assert_allclose(
            orientations(after)[4], wanted @ orientations(tiles)[4], atol=1e-8
        )
        np.testing.assert_array_equal(orientations(after)[3], orientations(tiles)[3])
