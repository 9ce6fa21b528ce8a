"""Ways of hands with a needle: constant speeds, changing ones with stops and releases, pushes."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

import numpy as np

from campaign.trials.steered_needle import Hand

FASTEST = 0.005
"""Of a driven needle, and of a push but for its jerks [m/s]."""
JERK = 0.02
"""Speed of a jerk [m/s]."""
_LONGEST = 600.0
_JERK_TIME, _JERK_CHANCE = 0.05, 0.03
_RELEASED, _STOPPED = 0.1, 0.2


def constant(speed: float) -> Callable[[float], Hand]:
    """Return a hand that holds at a speed [m/s] of `FASTEST`."""
    return lambda _: Hand(True, speed / FASTEST)


def changing(rng: np.random.Generator) -> Callable[[float], Hand]:
    """Return a hand that goes on at another speed, stops or lets go every 0.3 to 3 s."""
    share = _pieces(rng)

    def hand(time: float) -> Hand:
        u = share(time)
        if u < _RELEASED:
            return Hand(False, 0.0)
        return Hand(True, 0.0 if u < _STOPPED else u)

    return hand


def pushing(rng: np.random.Generator) -> Callable[[float], Hand]:
    """Return a hand that pushes the needle itself, with jerks, stops and releases."""
    share = _pieces(rng)
    jerks = rng.uniform(size=round(_LONGEST / _JERK_TIME)) < _JERK_CHANCE

    def hand(time: float) -> Hand:
        u = share(time)
        if u < _RELEASED:
            return Hand(False)
        jerk = jerks[int(time / _JERK_TIME)]
        return Hand(True, push=JERK if jerk else 0.0 if u < _STOPPED else u * FASTEST)

    return hand


def _pieces(rng: np.random.Generator) -> Callable[[float], float]:
    ends = np.cumsum(rng.uniform(0.3, 3.0, size=round(_LONGEST)))
    shares = rng.uniform(size=len(ends) + 1)
    return lambda time: float(shares[bisect_right(ends.tolist(), time)])
