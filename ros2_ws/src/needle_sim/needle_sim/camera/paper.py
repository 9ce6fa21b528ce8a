"""Graph paper under the phantom: lines as dark as a needle, in the way of its end."""

from __future__ import annotations

import numpy as np

from needle_sim.camera.scenarios import GraphPaper
from needle_sim.needle.se3 import FloatArray

_LENGTHS, _SIDES = (-0.02, 0.16), (-0.07, 0.07)
_POINTS = 60
_LARGEST_TURN = 0.35


def paper_lines(
    paper: GraphPaper, half_height: float, rng: np.random.Generator
) -> list[FloatArray]:
    """Return the lines of a paper that lies askew, each (M, 3) in `rig` [m].

    Parameters
    ----------
    paper : GraphPaper
        How it is ruled.
    half_height : float
        Of the phantom, from the needle's entry to its surface [m].
    rng : numpy.random.Generator
        For how it lies.
    """
    turn, aside, ahead = rng.uniform(-_LARGEST_TURN, _LARGEST_TURN), *rng.uniform(0.0, 1.0, 2)
    along = np.array([0.0, np.sin(turn), np.cos(turn)])
    across = np.array([0.0, np.cos(turn), -np.sin(turn)])
    middle = np.array([half_height - paper.floor_depth, 0.0, float(np.mean(_LENGTHS))])
    reach = float(np.hypot(np.ptp(_LENGTHS), np.ptp(_SIDES))) / 2.0
    count = int(reach / paper.pitch)
    places = np.linspace(-reach, reach, _POINTS)[:, np.newaxis]
    lines = []
    for k in range(-count, count + 1):
        for direction, beside, offset in ((along, across, aside), (across, along, ahead)):
            line = middle + (k + offset) * paper.pitch * beside + places * direction
            inside = (line[:, 2] > _LENGTHS[0]) & (line[:, 2] < _LENGTHS[1])
            inside &= (line[:, 1] > _SIDES[0]) & (line[:, 1] < _SIDES[1])
            if inside.sum() > 1:
                lines.append(line[inside])
    return lines
