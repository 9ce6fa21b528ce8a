"""The chart of r1 over depth, as options of ECharts."""

from __future__ import annotations

import math
from typing import Any

from needle_console.view.snapshot import Snapshot

# Of Okabe and Ito's palette: told apart by whoever does not tell red from green.
BLUE, ORANGE, GREY = "#0072b2", "#e69f00", "#8a8f98"
GOAL_MM = 1.0
_MM = 1e3
_BAND = "\N{PLUS-MINUS SIGN}2 sigma"
_DEFAULT_DEPTH_MM = 120.0


def chart_options(snapshot: Snapshot) -> dict[str, Any]:
    """Return the chart: r1 as a line, twice its sigma as a band, the goal as two dashed lines.

    Parameters
    ----------
    snapshot : Snapshot
        The rig; mm in the chart.
    """
    rows = [(p.depth * _MM, p.r1 * _MM, 2.0 * p.sigma * _MM) for p in snapshot.course]
    limit = max([1.5 * GOAL_MM, *(1.1 * (abs(r1) + half) for _, r1, half in rows)])
    controller = snapshot.controller
    depth = math.nan if controller is None else controller.depth
    last = _DEFAULT_DEPTH_MM if math.isnan(depth) else depth * _MM
    return {
        "animation": False,
        "grid": {"left": 46, "right": 14, "top": 30, "bottom": 36},
        "legend": {"top": 0, "textStyle": {"color": GREY}, "data": ["r1", _BAND]},
        "xAxis": {
            **_axis("depth [mm]", 22),
            "min": 0,
            "max": round(max([last, *(row[0] for row in rows)]), 1),
        },
        "yAxis": {
            **_axis("r1 [mm]", 32),
            "min": -_round_up(limit),
            "max": _round_up(limit),
        },
        "series": [
            # The band: its lower edge carries the rest, stacked on top of it.
            _edge([[at, r1 - half] for at, r1, half in rows]),
            {
                **_edge([[at, 2.0 * half] for at, _, half in rows]),
                "name": _BAND,
                "color": BLUE,
                "areaStyle": {"color": BLUE, "opacity": 0.25},
            },
            {
                "name": "r1",
                "type": "line",
                "showSymbol": False,
                "color": BLUE,
                "lineStyle": {"width": 2},
                "data": [[at, r1] for at, r1, _ in rows],
                "markLine": {
                    "symbol": "none",
                    "silent": True,
                    "label": {"formatter": "goal", "position": "insideEndTop", "color": GREY},
                    "lineStyle": {"color": ORANGE, "type": "dashed", "width": 1.5},
                    "data": [{"yAxis": GOAL_MM}, {"yAxis": -GOAL_MM}],
                },
            },
        ],
    }


def _round_up(limit: float) -> float:
    """Return an even limit, so that the axis does not move with every point."""
    return 2.0 * math.ceil(0.5 * limit)


def _edge(data: list[list[float]]) -> dict[str, Any]:
    return {
        "type": "line",
        "stack": "band",
        "stackStrategy": "all",
        "showSymbol": False,
        "silent": True,
        "lineStyle": {"opacity": 0},
        "data": data,
    }


def _axis(name: str, gap: int) -> dict[str, Any]:
    return {
        "type": "value",
        "name": name,
        "nameLocation": "middle",
        "nameGap": gap,
        "nameTextStyle": {"color": GREY},
        "axisLabel": {"color": GREY},
        "splitLine": {"lineStyle": {"color": GREY, "opacity": 0.25}},
    }
