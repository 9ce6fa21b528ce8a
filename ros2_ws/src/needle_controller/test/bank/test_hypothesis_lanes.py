"""The layout of a bank: what is written is what is read, row by row and lane by lane."""

from __future__ import annotations

import numpy as np

from needle_controller.bank.hypothesis_lanes import (
    BLOCK,
    LANES,
    P00,
    P43,
    P77,
    R12,
    X,
    blocks_for,
    covariances,
    rows,
    set_covariances,
    set_rows,
)


def test_rows_come_back() -> None:
    rng = np.random.default_rng(1)
    state = rng.normal(size=(3, 2, BLOCK))
    values = rng.normal(size=(3, 2 * LANES, 3))
    set_rows(state, X, values)
    np.testing.assert_array_equal(rows(state, X, 3), values)
    # Needle 1, hypothesis 11: block 1, lane 3.
    assert state[1, 1, X + 2 * LANES + 3] == values[1, 11, 2]
    assert rows(state, R12, 1)[2, 4, 0] == state[2, 0, R12 + 4]


def test_covariances_come_back_whole() -> None:
    rng = np.random.default_rng(2)
    factor = rng.normal(size=(2, LANES, 8, 8))
    wanted = factor @ np.swapaxes(factor, -1, -2)
    state = np.zeros((2, 1, BLOCK))
    set_covariances(state, wanted)
    np.testing.assert_array_equal(covariances(state), np.swapaxes(covariances(state), -1, -2))
    np.testing.assert_allclose(covariances(state), wanted)
    for row, (i, j) in ((P00, (0, 0)), (P43, (4, 3)), (P77, (7, 7))):
        assert state[1, 0, row + 5] == wanted[1, 5, i, j]


def test_blocks_are_rounded_up() -> None:
    assert [blocks_for(count) for count in (1, 8, 9, 48)] == [1, 1, 2, 6]
