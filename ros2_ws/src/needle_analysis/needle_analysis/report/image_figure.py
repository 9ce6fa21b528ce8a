"""The images of a run with the tip drawn in: measured, and where the truth says it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
import yaml
from matplotlib.figure import Figure

from needle_analysis.report.figure_style import WIDTH, place
from needle_analysis.run.run_summary import finite_tips
from needle_bags.reading.bag_images import SIDES, exposures, images_at
from needle_bags.reading.bag_reader import Run
from needle_common.errors import UserError
from needle_tracker.optics.calibration import parse_calibration

Floats = npt.NDArray[np.float64]
Projection = Callable[[Floats], Floats]

SHOWN = 3
_HALF_WIDTH_PX = 110


def images_figure(run: Run) -> Figure | None:
    """Return a few exposures of both cameras, cut out around the tip; None without images.

    Each column is one exposure. The circle is the measured tip projected back into the image
    through the calibration in the bag, the cross is the truth.
    """
    chosen = _choose_exposures(run)
    pictures = {(index, side): image for index, side, image in images_at(run, chosen)}
    if not pictures:
        return None
    projections = _projections(run)
    with mpl.rc_context({"font.size": 9}):
        columns = sorted({index for index, _ in pictures})
        figure = Figure(figsize=(WIDTH, 4.9))
        place(figure, len(SIDES), gap=0.26, left=0.04, right=0.04, bottom=0.04, top=0.24)
        figure.subplots_adjust(wspace=0.04)
        grid = figure.subplots(len(SIDES), len(columns), squeeze=False)
        insertion = run.insertion_at(chosen) * 1e3
        for column, index in enumerate(columns):
            for row, side in enumerate(SIDES):
                axes = grid[row][column]
                axes.set_axis_off()
                image = pictures.get((index, side))
                if image is None:
                    continue
                _draw_exposure(axes, run, int(chosen[index]), image, projections.get(side))
                axes.set_title(f"{side}, {insertion[index]:.0f} mm", fontsize=9)
        return figure


def _choose_exposures(run: Run) -> npt.NDArray[np.int64]:
    """Return stamps of measured tips, spread evenly over the part that cameras can see."""
    stamps = np.intersect1d(finite_tips(run).stamps, exposures(run))
    if not len(stamps):
        return stamps
    depth = run.insertion_at(stamps)
    wanted = np.linspace(0.0, 1.0, SHOWN + 1)[1:] * np.nanmax(depth)
    indices = [int(np.nanargmin(np.abs(depth - target))) for target in wanted]
    chosen: npt.NDArray[np.int64] = stamps[sorted(set(indices))]
    return chosen


def _projections(run: Run) -> dict[str, Projection]:
    # A run without images needs nothing that is compiled.
    from needle_tracker.optics.refraction import stereo_views  # noqa: PLC0415

    try:
        calibration = parse_calibration(yaml.safe_load(run.calibration))
    except (UserError, yaml.YAMLError):
        return {}
    views = stereo_views(calibration)
    return {side: view.project for side, view in zip(SIDES, views, strict=True)}


def _draw_exposure(
    axes: Any,
    run: Run,
    stamp: int,
    image: npt.NDArray[np.uint8],
    project: Projection | None,
) -> None:
    low, high = np.percentile(image, [0.5, 99.8])
    shown = {"cmap": "gray", "vmin": low, "vmax": high, "interpolation": "nearest"}
    if project is None:
        axes.imshow(image, **shown)
        return
    tip = run.tips.values[run.tips.stamps == stamp][0]
    measured = np.ravel(project(tip))
    circle: dict[str, Any] = {"markerfacecolor": "none", "markeredgewidth": 1.6}
    axes.plot(*measured, "o", markersize=16, markeredgecolor="#ff8a1f", **circle)
    truth = run.truth.values[run.truth.stamps == stamp, :3]
    if len(truth):
        true = np.ravel(project(truth[0]))
        axes.plot(*true, "+", markersize=11, markeredgecolor="#35e06d", markeredgewidth=1.3)
    centre = np.clip(measured, _HALF_WIDTH_PX, np.subtract(image.shape[::-1], _HALF_WIDTH_PX))
    u, v = np.maximum(np.floor(centre - _HALF_WIDTH_PX), 0).astype(int)
    side = 2 * _HALF_WIDTH_PX + 2
    cut = image[v : v + side, u : u + side]
    edges = (u - 0.5, u + cut.shape[1] - 0.5, v + cut.shape[0] - 0.5, v - 0.5)
    axes.imshow(cut, extent=edges, **shown)
    axes.set_xlim(centre[0] - _HALF_WIDTH_PX, centre[0] + _HALF_WIDTH_PX)
    axes.set_ylim(centre[1] + _HALF_WIDTH_PX, centre[1] - _HALF_WIDTH_PX)
