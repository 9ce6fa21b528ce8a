"""Part of the search grid in which a needle can be whose way so far is known.

A needle goes where its tip has been: what was believed of the tip says where the shaft lies now. A
line that crosses the phantom, a shadow or the edge of a hand then has no part in the search, except
where it comes close to the needle itself.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_tracker.image.search_grid import SearchGrid
from needle_tracker.optics.refraction import RefractedCamera

Array = NDArray[np.float64]


def within_corridor(
    grid: SearchGrid, view: RefractedCamera, way: Array, half_widths: Array
) -> SearchGrid:
    """Return the grid with only those cells reachable that lie near a way through the phantom.

    Parameters
    ----------
    grid : SearchGrid
        The camera's grid.
    view : RefractedCamera
        The camera.
    way : ndarray, shape (n, 3)
        Points that the needle passes, outwards, in `rig` [m].
    half_widths : ndarray, shape (n,)
        How far beside each of them the needle may be [m].

    Returns
    -------
    SearchGrid
        Before the first point all cells stay as they were; beyond the last none is reachable that
        lies farther than its half width.
    """
    origins, directions = view.rays(view.project(way))
    facing = np.cross(grid.sideways, [0.0, 0.0, 1.0])
    # Where these lines of sight pass the grid's plane.
    with np.errstate(invalid="ignore", divide="ignore"):
        places = origins - (origins @ facing / (directions @ facing))[:, None] * directions
    aside, ahead = places @ grid.sideways, places[:, 2]
    distance = np.hypot(aside, ahead)
    known = np.flatnonzero(np.isfinite(distance))
    known = known[np.argsort(distance[known])]
    if len(known) == 0:
        return grid
    angle = np.arctan2(aside[known], ahead[known])
    middle = np.interp(grid.distances, distance[known], angle)
    allowed = np.interp(grid.distances, distance[known], half_widths[known]) / grid.distances
    near = np.abs(grid.angles[None, :] - middle[:, None]) <= allowed[:, None]
    near[grid.distances < distance[known[0]]] = True
    near[grid.distances > distance[known[-1]] + half_widths[known[-1]]] = False
    return dataclasses.replace(grid, reachable=grid.reachable & near)
