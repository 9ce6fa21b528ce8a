"""Turn of the needle's base as a dial."""

from __future__ import annotations

import math


def dial(rotation: float) -> str:
    """Return an SVG of a pointer: up at 0, and clockwise as seen from behind the needle.

    Parameters
    ----------
    rotation : float
        Of the base [rad]; NaN draws no pointer.
    """
    pointer = ""
    if math.isfinite(rotation):
        x, y = 24.0 + 18.0 * math.sin(rotation), 24.0 - 18.0 * math.cos(rotation)
        pointer = (
            f'<line x1="24" y1="24" x2="{x:.2f}" y2="{y:.2f}" stroke="#0072b2" stroke-width="4" '
            'stroke-linecap="round"/>'
        )
    return (
        '<svg viewBox="0 0 48 48" width="48" height="48" aria-hidden="true">'
        '<circle cx="24" cy="24" r="21" fill="none" stroke="#8a8f98" stroke-width="2"/>'
        '<line x1="24" y1="1" x2="24" y2="8" stroke="#8a8f98" stroke-width="2"/>'
        f"{pointer}</svg>"
    )
