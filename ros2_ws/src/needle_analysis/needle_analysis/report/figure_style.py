"""Style of all figures of a run, and the units that people read."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

TRUTH = "#1b1b1b"
MEASURED = "#d1701b"
ESTIMATE = "#1668b0"
GOAL_BAND = "#2e9d55"
MM = 1e3
VIOLET, TEAL, GREY, RED = "#7a5ab5", "#3f8f8b", "#9aa0a8", "#b3261e"
# Narrow, so that the text can still be read on a phone [inch].
WIDTH = 6.6
# Room for five digits and a label; an axis with its label; a title [inch].
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
    figure.savefig(target, dpi=130, facecolor="white", metadata={"Software": ""})


def place(figure: Figure, rows: int, *, gap: float = 0.34, **margins: float) -> None:
    """Place a figure's axes by fixed margins: a layout engine measures all text twice more.

    Parameters
    ----------
    figure : Figure
        Its axes are in a grid.
    rows : int
        Of the grid.
    gap : float
        Between rows: a title, and an axis with its label where each row has one [inch].
    **margins : float
        `left`, `right`, `bottom` and `top`, where others are needed [inch].
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
