"""Torsion of the shaft as the estimator models it: play, then a lag in inserted length; compiled.

[KC09] neglects torsion and names friction along the shaft as the likely cause of its "sluggish
response". Play D: the angle behind it stays until the base is D ahead, then follows at that
distance. Lag L: the tip follows that angle over the inserted length, d(tip)/dl = (behind - tip) /
L.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

from needle_core.compiled import compiled

_SHORT_RAMP = 1e-3


@compiled
def turn_tip(
    tip: float,
    behind_play: float,
    per_size: float,
    base: float,
    turn: float,
    length: float,
    play: float,
    lag_length: float,
) -> tuple[float, float, float]:
    """Return where the tip's rotation goes while the base turns evenly over a length.

    Parameters
    ----------
    tip, behind_play : float
        Angles of the tip and of the shaft behind the play, before [rad].
    per_size : float
        Derivative of `tip` with respect to the torsion's size, before: the lag length if there is
        one [rad/m], the play if not [-].
    base, turn : float
        Angle of the base before, and how far it turns [rad].
    length : float
        Inserted length [m].
    play : float
        Half width of the dead band D [rad].
    lag_length : float
        L [m]; 0 is none.

    Returns
    -------
    tip, behind_play, per_size : float
        The same, after.
    """
    # |base - behind| <= D
    after = base + turn
    behind = min(max(behind_play, after - play), after + play)
    change = behind - behind_play
    if lag_length == 0.0:
        # Behind the play the tip is where its near edge is: base -+ D.
        if change > 0.0:
            per_size = -1.0
        elif change < 0.0:
            per_size = 1.0
        return behind, behind, per_size
    if length <= 0.0:
        # The tip follows over inserted length only.
        return tip, behind, per_size
    # The play closes first; the ramp that follows it is the last part of the length, q lags long.
    share = min(max(change / turn, 0.0), 1.0) if turn != 0.0 else 1.0
    decay, q = math.exp(-length / lag_length), length * share / lag_length
    if q < _SHORT_RAMP:
        part, slope = 0.5 * q, -0.5 * q
    else:
        part = 1.0 + math.expm1(-q) / q
        slope = (math.exp(-q) * (1.0 + q) - 1.0) / q
    # tip(l) = behind_0 + (tip_0 - behind_0) exp(-l/L) + change (1 - (1 - exp(-q)) / q)
    distance = tip - behind_play
    by_lag = (per_size + distance * length / lag_length**2) * decay + change * slope / lag_length
    return behind_play + distance * decay + change * part, behind, by_lag
