"""Camera images of a run with the measured and the true tip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from needle_bags.figures.figure_style import WIDTH, place
from needle_bags.figures.film import Frame
from needle_bags.figures.film_views import Image, Projection, projections
from needle_bags.reading.bag_images import SIDES
from needle_bags.reading.bag_reader import Run

SHOWN = 3
_HALF_WIDTH_PX = 110


def frames_shown(run: Run, frames: Sequence[Frame]) -> list[int]:
    """Return the frames to show: some with a measured tip, spread over the insertion."""
    visible = [index for index, frame in enumerate(frames) if len(frame.shaft)]
    if not visible:
        return []
    depth = run.insertion_at(np.array([frames[index].stamp for index in visible]))
    if np.isnan(depth).all():
        return visible[-SHOWN:]
    wanted = np.linspace(0.0, 1.0, SHOWN + 1)[1:] * np.nanmax(depth)
    nearest = {visible[int(np.nanargmin(np.abs(depth - target)))] for target in wanted}
    return sorted(nearest)


def images_figure(
    run: Run, frames: Sequence[Frame], images: Mapping[tuple[int, str], Image]
) -> Figure | None:
    """Return a few exposures of both cameras, cut out around the tip; None without images.

    Each column is one exposure. The circle is the measured tip, projected with the calibration in
    the bag; the cross is the truth.

    Parameters
    ----------
    run : Run
        The recorded run.
    frames : sequence of Frame
        Its film.
    images : mapping
        Frame and side to the image (H, W), of those `frames_shown`.
    """
    if not images:
        return None
    seen_by = projections(run)
    with mpl.rc_context({"font.size": 9}):
        columns = sorted({index for index, _ in images})
        figure = Figure(figsize=(WIDTH, 4.2))
        place(figure, len(SIDES), gap=0.26, left=0.04, right=0.04, bottom=0.04, top=0.24)
        figure.subplots_adjust(wspace=0.04)
        grid = figure.subplots(len(SIDES), len(columns), squeeze=False)
        for column, index in enumerate(columns):
            for row, side in enumerate(SIDES):
                axes = grid[row][column]
                axes.set_axis_off()
                image = images.get((index, side))
                if image is None:
                    continue
                _draw_exposure(axes, run, frames[index], image, seen_by.get(side))
                axes.set_title(f"{side}, {frames[index].readings[0]}", fontsize=9)
        return figure


def _draw_exposure(
    axes: Any, run: Run, frame: Frame, image: Image, project: Projection | None
) -> None:
    low, high = np.percentile(image, [0.5, 99.8])
    shown = {"cmap": "gray", "vmin": low, "vmax": high, "interpolation": "nearest"}
    if project is None:
        axes.imshow(image, **shown)
        return
    measured = np.ravel(project(frame.shaft[-1]))
    circle: dict[str, Any] = {"markerfacecolor": "none", "markeredgewidth": 1.6}
    axes.plot(*measured, "o", markersize=16, markeredgecolor="#ff8a1f", **circle)
    truth = run.truth.values[run.truth.stamps == frame.stamp, :3]
    if len(truth):
        true = np.ravel(project(truth[0]))
        axes.plot(*true, "+", markersize=11, markeredgecolor="#35c5ff", markeredgewidth=1.5)
    centre = np.clip(measured, _HALF_WIDTH_PX, np.subtract(image.shape[::-1], _HALF_WIDTH_PX))
    u, v = np.maximum(np.floor(centre - _HALF_WIDTH_PX), 0).astype(int)
    side = 2 * _HALF_WIDTH_PX + 2
    cut = image[v : v + side, u : u + side]
    edges = (u - 0.5, u + cut.shape[1] - 0.5, v + cut.shape[0] - 0.5, v - 0.5)
    axes.imshow(cut, extent=edges, **shown)
    axes.set_xlim(centre[0] - _HALF_WIDTH_PX, centre[0] + _HALF_WIDTH_PX)
    axes.set_ylim(centre[1] + _HALF_WIDTH_PX, centre[1] - _HALF_WIDTH_PX)
