"""Style of all figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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
"""Style of the truth: broad, so that a thin line can be drawn over it."""
THIN: dict[str, Any] = {"color": ESTIMATE, "lw": 1.3}
DASHED, DOTTED = (0, (4, 2)), (0, (1, 1.4))
AXES: dict[str, dict[str, Any]] = {
    "x (out of the plane)": {"color": MEASURED, "lw": 1.1},
    "y (beside)": {"color": PLUM, "lw": 1.1, "ls": DASHED},
    "z (along)": {"color": TEAL, "lw": 1.3, "ls": DOTTED},
}
MM = 1e3
# Narrow enough to read the text on a phone [inch].
WIDTH = 5.6
# Space for five digits and a label; an axis with its label; a title [inch].
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


def place(figure: Figure, rows: int, *, gap: float = 0.34, **margins: float) -> None:
    """Place the axes of a figure by fixed margins; a layout engine takes three times as long.

    Parameters
    ----------
    figure : Figure
        A figure with a grid of axes.
    rows : int
        Rows of the grid.
    gap : float
        Space between rows, for a title and an axis with its label [inch].
    **margins : float
        `left`, `right`, `bottom` and `top`, if not the defaults [inch].
    """
    width, height = figure.get_size_inches()
    left, right, bottom, top = (margins.get(side, inch) for side, inch in _MARGINS.items())
    row = (height - bottom - top - gap * (rows - 1)) / rows
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        hspace=gap / row,
    )
