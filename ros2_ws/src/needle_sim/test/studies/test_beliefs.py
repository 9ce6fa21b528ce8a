from __future__ import annotations

import numpy as np

from needle_sim.studies.beliefs import Belief, BeliefTally


def test_shares_within_2_and_3_sigma_count_x_and_pitch_alike() -> None:
    # off by 1, 2.5 and 4 standard deviations in x; by none, none and 2.5 in sin(pitch)
    tally = BeliefTally(3)
    truth = np.array([0.001, 0.0025, 0.004]), np.arcsin([0.0, 0.0, 0.025])
    level, std = np.zeros(3), np.full(3, 0.001)
    tally.add(Belief(level, std, level, 10.0 * std), *truth)
    np.testing.assert_allclose(tally.inside, [[1.0, 0.5, 0.0], [1.0, 1.0, 0.5]])
    # a second step in which all is as believed
    tally.add(Belief(level, std, level, std), level, level)
    np.testing.assert_allclose(tally.inside, [[1.0, 0.75, 0.5], [1.0, 1.0, 0.75]])
    assert np.all(np.isnan(tally.doubtful))


def test_the_last_word_on_doubt_counts() -> None:
    tally, level = BeliefTally(2), np.zeros(2)
    for doubtful in ([True, False], [False, True]):
        tally.add(Belief(level, level, level, level, np.array(doubtful)), level, level)
    np.testing.assert_array_equal(tally.doubtful, [0.0, 1.0])


def test_nothing_said_is_nothing_compared() -> None:
    tally = BeliefTally(2)
    tally.add(None, np.zeros(2), np.zeros(2))
    assert np.all(np.isnan(tally.inside))
    assert np.all(np.isnan(tally.doubtful))
