"""The layout of estimates: what is written is what is read, and what has ended goes."""

from __future__ import annotations

import numpy as np

from needle_controller.bank.estimate_tiles import (
    ERROR,
    LANES,
    PAIRS,
    PLACE,
    ROWS,
    SHAPE,
    WEIGHT,
    P,
    R,
    X,
    covariances,
    lower_half,
    rows,
    set_rows,
    tidied,
    tiles_of,
)

COUNTS = np.array([LANES - 3, 9, 2 * LANES])


def numbers(seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    written = rng.uniform(0.1, 1.0, (int(np.sum(COUNTS)), ROWS))
    written[:, SHAPE] = rng.integers(0, 3, len(written))
    return written


def test_rows_come_back() -> None:
    written = numbers()
    tiles = tiles_of(written, COUNTS)
    np.testing.assert_array_equal(rows(tiles, X, 3), written[:, X : X + 3])
    for n, k in ((0, 0), (1, 3), (2, LANES)):
        e = tiles.first[n] + k
        slot = tiles.slot[e]
        assert tiles.state[slot // LANES, R + 5, slot % LANES] == written[e, R + 5]
        assert tiles.owner[slot] == n
    set_rows(tiles, R, -written[:, R : R + 9])
    np.testing.assert_array_equal(rows(tiles, R, 9), -written[:, R : R + 9])


def test_those_of_one_shape_of_noise_lie_side_by_side() -> None:
    tiles = tiles_of(numbers(), COUNTS)
    assert np.all(np.diff(tiles.state[:, SHAPE].ravel()) >= 0.0)
    # All are there, each once.
    np.testing.assert_array_equal(np.sort(tiles.slot), np.arange(np.sum(COUNTS)))


def test_what_fills_the_last_tile_has_no_weight() -> None:
    tiles = tiles_of(numbers(), COUNTS)
    weights = tiles.state[:, WEIGHT].ravel()
    assert np.all(weights[: tiles.first[-1]] > 0.0)
    assert len(weights) > tiles.first[-1]
    np.testing.assert_array_equal(weights[tiles.first[-1] :], 0.0)


def test_covariances_come_back_whole() -> None:
    factor = np.random.default_rng(2).normal(size=(int(np.sum(COUNTS)), ERROR, ERROR))
    wanted = factor @ np.swapaxes(factor, -1, -2)
    written = numbers()
    written[:, P : P + PAIRS] = lower_half(wanted)
    tiles = tiles_of(written, COUNTS)
    np.testing.assert_allclose(covariances(tiles), wanted)
    tile, lane = divmod(tiles.slot[5], LANES)
    assert tiles.state[tile, PLACE[3, 7], lane] == wanted[5, 7, 3]
    assert PLACE[7, 3] == PLACE[3, 7]


def test_what_has_ended_goes_but_for_some_room() -> None:
    written = numbers()
    ends = np.random.default_rng(3).random(len(written)) < 0.5
    # All of the first needle's go on.
    ends[: COUNTS[0]] = False
    written[ends, WEIGHT] = 0.0
    tiles = tidied(tiles_of(written, COUNTS))
    for n in range(3):
        kept = rows(tiles, 0, ROWS)[tiles.first[n] : tiles.first[n + 1]]
        mine = np.repeat(np.arange(3), COUNTS) == n
        # In their order: the first of those that have ended are the room.
        room = 1 + np.count_nonzero(mine & ~ends) // 4
        stays = ~ends | (np.cumsum(mine & ends) <= room)
        np.testing.assert_array_equal(kept, written[mine & stays])
        slots = tiles.slot[tiles.first[n] : tiles.first[n + 1]]
        np.testing.assert_array_equal(tiles.owner[slots], n)
    np.testing.assert_array_equal(tiles.state[:, WEIGHT].ravel()[tiles.first[-1] :], 0.0)
