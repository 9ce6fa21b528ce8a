"""r1 over depth, with its sigma and the goal."""

from __future__ import annotations

from nicegui import ui

from needle_console.view.chart import chart_options
from needle_console.view.snapshot import Snapshot


class R1Chart:
    """The chart; sent anew only where it has changed."""

    def __init__(self) -> None:
        self._shown = chart_options(Snapshot())
        with ui.element("figure").classes("tile chart"):
            self._chart = ui.echart(self._shown).classes("drawing")
            self._chart.props('role="img" aria-label="r1 over depth, with its sigma and the goal"')

    def show(self, snapshot: Snapshot) -> None:
        """Show a snapshot's course."""
        options = chart_options(snapshot)
        if options == self._shown:
            return
        self._shown = options
        self._chart.options.clear()
        self._chart.options.update(options)
        self._chart.update()
