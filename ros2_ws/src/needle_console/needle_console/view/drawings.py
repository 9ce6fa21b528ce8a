"""SVG drawings: chart of r1 over depth, dial of the rotation.

They need no browser library; loading one could delay the hold.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from needle_console.view.snapshot import Snapshot

# From the palette of Okabe and Ito, which suits red-green colour blindness.
BLUE, ORANGE, GREY = "#0072b2", "#e69f00", "#8a8f98"
GOAL_MM = 1.0
_MM = 1e3
_DEFAULT_DEPTH_MM = 120.0
# Chart and frame in pixels at 1280x720.
_WIDTH, _HEIGHT = 460.0, 290.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 446.0, 26.0, 252.0
_TICKS_ACROSS, _TICKS_UP = 6, 6


class _Frame:
    """Axes of the chart: pixel coordinates of depths and distances [mm], and the grid.

    Parameters
    ----------
    depth : float
        Depth at the right edge [mm]; the left edge is at 0.
    limit : float
        Distance at the upper edge, and its negative at the lower edge [mm].
    """

    def __init__(self, depth: float, limit: float) -> None:
        self._depth = depth
        self._limit = limit

    def x(self, depth: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * depth / self._depth

    def y(self, r1: float) -> float:
        return 0.5 * (_TOP + _BOTTOM) - 0.5 * (_BOTTOM - _TOP) * r1 / self._limit

    def path(self, points: Iterable[tuple[float, float]]) -> str:
        return " ".join(f"{self.x(depth):.1f},{self.y(r1):.1f}" for depth, r1 in points)

    def across(self, r1: float, style: str) -> str:
        y = f"{self.y(r1):.1f}"
        return f'<line x1="{_LEFT}" x2="{_RIGHT}" y1="{y}" y2="{y}" {style}/>'

    def grid(self) -> str:
        style = f'stroke="{GREY}" stroke-opacity="0.25"'
        parts = []
        for depth in _ticks(0.0, self._depth, _TICKS_ACROSS):
            x = f"{self.x(depth):.1f}"
            parts.append(f'<line x1="{x}" x2="{x}" y1="{_TOP}" y2="{_BOTTOM}" {style}/>')
            parts.append(_text(self.x(depth), _BOTTOM + 14.0, f"{depth:g}"))
        for r1 in _ticks(-self._limit, self._limit, _TICKS_UP):
            parts.append(self.across(r1, style))
            parts.append(_text(_LEFT - 5.0, self.y(r1) + 4.0, f"{r1:g}", "end"))
        return "".join(parts)


def chart(snapshot: Snapshot) -> str:
    """Return the chart: r1 as a line, 2 sigma as a band, the goal as two dashed lines.

    Parameters
    ----------
    snapshot : Snapshot
        State of the rig.
    """
    rows = [(p.depth * _MM, p.r1 * _MM, 2.0 * p.sigma * _MM) for p in snapshot.track]
    limit = max([1.5 * GOAL_MM, *(1.1 * (abs(r1) + half) for _, r1, half in rows)])
    controller = snapshot.controller
    depth = None if controller is None else controller.depth_m
    last = _DEFAULT_DEPTH_MM if depth is None else depth * _MM
    frame = _Frame(max([last, *(row[0] for row in rows)]), _round_up(limit))
    upper = [(at, r1 + half) for at, r1, half in rows]
    lower = [(at, r1 - half) for at, r1, half in rows]
    goal = f'stroke="{ORANGE}" stroke-width="1.5" stroke-dasharray="5 4"'
    return (
        f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" width="100%" height="100%" role="img" '
        'aria-label="r1 over depth, with its sigma and the goal" font-size="12">'
        f"{frame.grid()}"
        f'<polygon points="{frame.path([*upper, *reversed(lower)])}" fill="{BLUE}" '
        'fill-opacity="0.25"/>'
        f"{frame.across(GOAL_MM, goal)}{frame.across(-GOAL_MM, goal)}"
        f'<polyline points="{frame.path((at, r1) for at, r1, _ in rows)}" fill="none" '
        f'stroke="{BLUE}" stroke-width="2"/>'
        f"{_legend()}"
        f"{_text(0.5 * (_LEFT + _RIGHT), _HEIGHT - 6.0, 'depth [mm]')}"
        f'<g transform="rotate(-90)">{_text(-0.5 * (_TOP + _BOTTOM), 13.0, "r1 [mm]")}</g></svg>'
    )


def _legend() -> str:
    line = f'<line x1="130" x2="154" y1="13" y2="13" stroke="{BLUE}" stroke-width="2"/>'
    band = f'<rect x="190" y="7" width="24" height="12" fill="{BLUE}" fill-opacity="0.25"/>'
    goal = (
        f'<line x1="290" x2="314" y1="13" y2="13" stroke="{ORANGE}" stroke-width="1.5" '
        'stroke-dasharray="5 4"/>'
    )
    words = ((159.0, "r1"), (219.0, "\N{PLUS-MINUS SIGN}2 sigma"), (319.0, "goal"))
    return line + band + goal + "".join(_text(x, 17.0, word, "start") for x, word in words)


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{GREY}" text-anchor="{anchor}">{text}</text>'


def _ticks(begin: float, end: float, most: int) -> Iterable[float]:
    """Return round numbers within two bounds, at most about `most`."""
    rough = (end - begin) / most
    decade = 10.0 ** math.floor(math.log10(rough))
    step = decade * next(digit for digit in (1.0, 2.0, 5.0, 10.0) if digit * decade >= rough)
    return [step * n for n in np.arange(math.ceil(begin / step), math.floor(end / step) + 1)]


def _round_up(limit: float) -> float:
    """Return the next even limit, so that the axis does not change with every point."""
    return 2.0 * math.ceil(0.5 * limit)


def dial(rotation: float) -> str:
    """Return a dial with a pointer: up at 0, clockwise as seen from behind the needle.

    Parameters
    ----------
    rotation : float
        Rotation of the base [rad]; NaN draws no pointer.
    """
    pointer = ""
    if math.isfinite(rotation):
        x, y = 24.0 + 18.0 * math.sin(rotation), 24.0 - 18.0 * math.cos(rotation)
        pointer = (
            f'<line x1="24" y1="24" x2="{x:.2f}" y2="{y:.2f}" stroke="{BLUE}" stroke-width="4" '
            'stroke-linecap="round"/>'
        )
    return (
        '<svg viewBox="0 0 48 48" width="48" height="48" aria-hidden="true">'
        f'<circle cx="24" cy="24" r="21" fill="none" stroke="{GREY}" stroke-width="2"/>'
        f'<line x1="24" y1="1" x2="24" y2="8" stroke="{GREY}" stroke-width="2"/>'
        f"{pointer}</svg>"
    )
