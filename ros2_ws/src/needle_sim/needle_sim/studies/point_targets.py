"""Points for the needles of a study to go to, and how they move meanwhile."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies import study_noise

NEAREST, FARTHEST = 0.060, 0.120
"""How far ahead of their starts the points lie [m]."""
CURVATURE_SHARE = 0.6
"""Share of the needle's curvature that the arc from the true start to the point takes at most. What
a hand can aim at is more; but over its first centimetres a needle does not know yet how it lies."""
BREATHING_RATE = 0.2
"""Of targets that breathe [Hz]."""
INSERTION_SPEED = 0.002
"""How fast the needles of a study go in, where that matters [m/s]."""


@dataclasses.dataclass(frozen=True, eq=False)
class MovingTargets:
    """Targets that drift and breathe, each in directions and with a phase of its own.

    Attributes
    ----------
    places : ndarray, shape (N, 3)
        Where they are at the begin but for the breath [m].
    drift : float
        How fast each drifts [m/s].
    breath : float
        Amplitude of their breathing, a sine of time [m].
    seed, first : int
        Key the randomness: of the study, and the first target.
    """

    places: FloatArray
    drift: float = 0.0
    breath: float = 0.0
    seed: int = 0
    first: int = 0

    def part(self, first: int, count: int) -> MovingTargets:
        """Return `count` of the targets, as they are here."""
        places = self.places[first : first + count]
        return dataclasses.replace(self, places=places, first=self.first + first)

    def at(self, time: FloatArray | float) -> FloatArray:
        """Return where they are, (N, 3) [m], at a time of each or of all [s]."""
        count = len(self.places)
        passed = np.broadcast_to(np.asarray(time, dtype=float), (count,))[:, None]
        drifts, breaths = (
            study_noise.uniform(self.seed, purpose, 0, self.first, count)
            for purpose in (study_noise.DRIFT, study_noise.BREATH)
        )
        drift, breath = study_noise.directions(drifts), study_noise.directions(breaths)
        phase = breaths[:, 2:3].astype(np.float64)
        swing = np.sin(2.0 * np.pi * (BREATHING_RATE * passed + phase))
        return np.asarray(self.places + self.drift * passed * drift + self.breath * swing * breath)


def random_targets(starts: FloatArray, curvature: float, seed: int) -> FloatArray:
    """Return a point for each needle that it can reach from where it really starts.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    curvature : float
        Of a needle's path [1/m].
    seed : int
        Of all randomness.

    Returns
    -------
    ndarray, shape (N, 3)
        Distance ahead uniform, the place across it uniform within what can be reached [m].
    """
    count = len(starts)
    share = study_noise.uniform(seed, study_noise.TARGET, 0, 0, count).astype(np.float64)
    ahead = NEAREST + (FARTHEST - NEAREST) * share[:, 0]
    tightest = CURVATURE_SHARE * curvature
    # On an arc of that curvature: ahead^2 = across (2 / tightest - across).
    widest = (1.0 - np.sqrt(1.0 - (tightest * ahead) ** 2)) / tightest
    across, around = widest * np.sqrt(share[:, 1]), 2.0 * np.pi * share[:, 2]
    up, aside = across * np.cos(around), across * np.sin(around)
    x, pitch, _ = starts.T
    cosine, sine = np.cos(pitch), np.sin(pitch)
    return np.stack([x + cosine * up + sine * ahead, aside, cosine * ahead - sine * up], axis=-1)
