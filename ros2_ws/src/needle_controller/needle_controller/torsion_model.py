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

from needle_common.compiled import compiled


@compiled
def turn_tip(
    tip: float,
    behind_play: float,
    per_torsion: float,
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
    per_torsion : float
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
    tip, behind_play, per_torsion : float
        The same, after.
    """
    after = base + turn
    behind = min(max(behind_play, after - play), after + play)
    change = behind - behind_play
    if lag_length <= 0.0:
        if change > 0.0:
            per_torsion = -1.0
        elif change < 0.0:
            per_torsion = 1.0
        return behind, behind, per_torsion
    # The play closes first; the ramp that follows it is the last part of the length.
    ramp = length * min(change / turn, 1.0) / lag_length if change != 0.0 else 0.0
    decay = math.exp(-length / lag_length)
    distance = tip - behind_play
    moved = behind_play + distance * decay
    per_torsion = (per_torsion + distance * length / (lag_length * lag_length)) * decay
    if ramp > 1e-6:
        ramp_decay = math.exp(-ramp)
        moved += change * (1.0 - (1.0 - ramp_decay) / ramp)
        per_torsion += change * (ramp_decay * (1.0 + ramp) - 1.0) / (ramp * lag_length)
    return moved, behind, per_torsion
