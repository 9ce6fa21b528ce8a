"""Style of all figures."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from needle_bags.run.run_summary import GOAL

# Distinguishable with any colour vision deficiency, on light and dark backgrounds.
INK = "#1b1b1b"
TRUTH = "#8d9299"
MEASURED = "#cf6a00"
ESTIMATE = "#0067b1"
GOAL_BAND = "#207a30"
PLUM, TEAL, RED = "#7a1050", "#2099c0", "#b3140c"
# For zero lines and shadows only.
GREY = "#9aa0a8"
BROAD: dict[str, Any] = {"color": TRUTH, "lw": 3.6, "solid_capstyle": "round"}
"""Style of the ground truth: wide, so that a thin line can be drawn over it."""
MM = 1e3
# Narrow enough to read the text on a phone [inch].
WIDTH = 5.6
# Space between rows for a title and an axis, and margins: at the left for five digits and a label,
# at the bottom for an axis with its label, and at the top for a title [inch].
_GAP = 0.34
_MARGINS = {"left": 0.75, "right": 0.12, "bottom": 0.5, "top": 0.3}
STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.formatter.useoffset": False,
    "axes.grid": True,
    "grid.color": "#e4e6ea",
    "grid.linewidth": 0.8,
    "axes.edgecolor": "#9aa0a8",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


def save(figure: Figure, target: Path | BinaryIO) -> None:
    """Write a figure as PNG."""
    FigureCanvasAgg(figure)
    figure.savefig(target, dpi=150, facecolor="white", metadata={"Software": ""})


def png_size(png: bytes) -> tuple[int, int]:
    """Return a PNG file's width and height [px]."""
    return int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big")


@contextlib.contextmanager
def stacked(rows: int, height: float, **margins: float) -> Iterator[tuple[Figure, list[Any]]]:
    """Yield a figure and its axes, one below the other, in the common style.

    The margins are fixed, because a layout engine would take three times as long.

    Parameters
    ----------
    rows : int
        Number of axes.
    height : float
        Height of the figure [inch].
    **margins : float
        Values of `left`, `right`, `bottom` and `top` that replace the defaults [inch].
    """
    left, right, bottom, top = (margins.get(side, inch) for side, inch in _MARGINS.items())
    row = (height - bottom - top - _GAP * (rows - 1)) / rows
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height))
        figure.subplots_adjust(
            left=left / WIDTH,
            right=1.0 - right / WIDTH,
            bottom=bottom / height,
            top=1.0 - top / height,
            hspace=_GAP / row,
        )
        yield figure, list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])


def draw_goal(axes: Any, plane: float = 0.0) -> None:
    """Draw the target plane at a height [m], with the band in which a run counts as converged."""
    band = ((plane - GOAL) * MM, (plane + GOAL) * MM)
    axes.axhspan(*band, color=GOAL_BAND, alpha=0.16, lw=0)
    axes.axhline(plane * MM, color=GOAL_BAND, lw=1.3)
