"""A standard normal cut off at two bounds: mass, mean and variance, without a branch; compiled.

Written so that a compiler can do several at once: no calls to the mathematical library.
"""

from __future__ import annotations

from needle_core.compiled import inlined

FAR = 5.5
"""Bounds beyond so many standard deviations count as none."""
_DENSITY = 0.3989422804014327


@inlined
def falling_exponential(x: float) -> float:
    """Return exp(x) for x in [-16, 0], to 3e-11 of itself; below -16 it is exp(-16)."""
    y = max(x, -16.0) * (1.0 / 64.0)
    e = 1.0 + y * (1.0 / 8.0) * (1.0 + y * (1.0 / 9.0))
    e = 1.0 + y * (1.0 / 6.0) * (1.0 + y * (1.0 / 7.0) * e)
    e = 1.0 + y * (1.0 / 4.0) * (1.0 + y * (1.0 / 5.0) * e)
    e = 1.0 + y * (1.0 / 2.0) * (1.0 + y * (1.0 / 3.0) * e)
    e = 1.0 + y * e
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    return e * e


@inlined
def tail_ratio(z: float) -> float:
    """Return P(Z > z) / exp(-z^2 / 2) of a standard normal Z for z in [0, 5.7], to 1.4e-8 of it.

    A polynomial in 1 / (1 + 0.3 z), fitted for the least largest relative error.
    """
    t = 1.0 / (1.0 + 0.3 * z)
    r = -0.1179682526 + t * 0.02860580021
    r = 0.0689985356 + t * (0.1134081515 + t * r)
    r = 0.1493868939 + t * (0.029914577 + t * r)
    r = 0.1222031494 + t * (0.1056383493 + t * r)
    return -0.0001871974762 + t * r


@inlined
def truncated_moments(lower: float, upper: float) -> tuple[float, float, float]:
    """Return mass, mean and variance of a standard normal between two bounds.

    Where the mass vanishes, mean and variance mean nothing (they are finite).

    Parameters
    ----------
    lower, upper : float
        The bounds; those beyond `FAR` count as none (an error below 1e-6).
    """
    below, above = min(abs(lower), FAR), min(abs(upper), FAR)
    bell_lower = falling_exponential(-0.5 * below * below) if below < FAR else 0.0
    bell_upper = falling_exponential(-0.5 * above * above) if above < FAR else 0.0
    tail_lower = bell_lower * tail_ratio(below)
    tail_upper = bell_upper * tail_ratio(above)
    # Differences of small tails, not of numbers near 1.
    mass = 1.0 - tail_lower - tail_upper
    mass = tail_lower - tail_upper if lower > 0.0 else mass
    mass = tail_upper - tail_lower if upper < 0.0 else mass
    density = _DENSITY / max(mass, 1e-30)
    mean = (bell_lower - bell_upper) * density
    # A bound that counts as none has no bell.
    variance = 1.0 + (lower * bell_lower - upper * bell_upper) * density - mean * mean
    return mass, mean, variance
