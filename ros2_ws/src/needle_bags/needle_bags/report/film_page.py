"""The film in the page: its last frame, and a script that shows the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from needle_bags.figures.film import READINGS, Frame
from needle_bags.figures.film_views import View
from needle_bags.report.html_page import base64_text, parts

_FRAMES_PER_SECOND = 8


def film_html(frames: Sequence[Frame], views: Sequence[View]) -> Markup:
    """Return the film; without a script, and on paper, it is its last frame.

    Parameters
    ----------
    frames : sequence of Frame
        In their order; one at least.
    views : sequence of View
        What is shown of them.
    """
    data = {
        "rate": _FRAMES_PER_SECOND,
        "readings": [frame.readings for frame in frames],
        "views": [
            {
                "pictures": None if view.is_chart else [base64_text(one) for one in view.pictures],
                "lines": [_points(line) for line in view.lines],
            }
            for view in views
        ],
    }
    return parts.film(READINGS, frames[-1].readings, views, data)


def _points(line: npt.NDArray[np.float64]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in line.tolist())
