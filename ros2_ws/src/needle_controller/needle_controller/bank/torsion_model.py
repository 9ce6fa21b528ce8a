"""Torsion of the shaft as the estimator models it: play, then a lag in inserted length; compiled.

[KC09] neglects torsion and names friction along the shaft as the likely cause of its "sluggish
response". Play D: the angle behind it stays until the base is D ahead, then follows at that
distance. Lag L: the tip follows that angle over the inserted length, d(tip)/dl = (behind - tip) /
L.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

from needle_controller.bank.normal_moments import falling_exponential
from needle_core.compiled import inlined

_SHORT_RAMP = 1e-3


@inlined
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
    after = base + turn
    behind = min(max(behind_play, after - play), after + play)
    change = behind - behind_play
    by_play = -1.0 if change > 0.0 else per_size
    by_play = 1.0 if change < 0.0 else by_play
    # The play closes first; the ramp that follows it is the last part of the length.
    lag = lag_length if lag_length > 0.0 else 1.0
    share = min(max(change / turn, 0.0), 1.0) if turn != 0.0 else 1.0
    ramp = length * share / lag
    long_ramp = max(ramp, _SHORT_RAMP)
    decay, ramp_decay = falling_exponential(-length / lag), falling_exponential(-ramp)
    distance = tip - behind_play
    # (1 - exp(-ramp)) / ramp and its like lose digits where the ramp is short.
    short = ramp < _SHORT_RAMP
    part = 0.5 * ramp if short else 1.0 - (1.0 - ramp_decay) / long_ramp
    slope = -0.5 * ramp if short else (ramp_decay * (1.0 + ramp) - 1.0) / long_ramp
    by_lag = (per_size + distance * length / (lag * lag)) * decay + change * slope / lag
    # Without insertion nothing follows, to the last bit.
    lagged = behind_play + distance * decay + change * part if length > 0.0 else tip
    has_lag = lag_length > 0.0
    return (
        lagged if has_lag else behind,
        behind,
        by_lag if has_lag else by_play,
    )
