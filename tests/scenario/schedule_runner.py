"""Runs a schedule of faults: each begins after its moment, and ends after its duration."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from needle_core.runners.timeline import Timeline
from scenario.faults import Fault, Moment
from scenario.rig import SoakRig

Undo = Callable[[], None]
# Moment at which a field of a status gets a value.
_DEVICE = {
    ("activity", "homing"): Moment.HOMING,
    ("state", "HOLDING"): Moment.HOLDING,
    ("state", "MOVING"): Moment.MOVING,
    ("state", "FAULT"): Moment.FAULT,
}
_CONTROLLER = {("state", "STEERING"): Moment.STEERING, ("state", "DONE"): Moment.DONE}


@dataclasses.dataclass(frozen=True)
class ReachedMoment:
    """A moment that was reached.

    Attributes
    ----------
    moment : Moment
        The moment.
    nth : int
        Number of its occurrence, from 1.
    at : float
        Time [s].
    """

    moment: Moment
    nth: int
    at: float


class ScheduleRunner:
    """Begins and ends the faults of a schedule.

    Parameters
    ----------
    timeline : Timeline
        Clock of the run.
    faults : sequence of Fault
        The schedule.
    begin : callable
        Begins a fault, and returns the function that ends it.

    Attributes
    ----------
    reached : list of ReachedMoment
        All moments so far, in order.
    begun : list of tuple of Fault and float
        Faults that began, with their times [s].
    """

    def __init__(
        self, timeline: Timeline, faults: Sequence[Fault], begin: Callable[[Fault], Undo]
    ) -> None:
        self._timeline = timeline
        self._begin = begin
        self._waiting = list(faults)
        self._active = 0
        self._count: Counter[Moment] = Counter()
        self.reached: list[ReachedMoment] = []
        self.begun: list[tuple[Fault, float]] = []

    @property
    def has_active(self) -> bool:
        """Whether a fault is active, or its moment was reached."""
        return self._active > 0

    @property
    def has_pending(self) -> bool:
        """Whether the moment of a fault was not reached yet."""
        return bool(self._waiting)

    def reach(self, moment: Moment) -> None:
        """Handle a moment: count it, and schedule the faults that follow it."""
        self._count[moment] += 1
        this = moment, self._count[moment]
        self.reached.append(ReachedMoment(*this, self._timeline.now))
        for fault in [one for one in self._waiting if (one.after, one.nth) == this]:
            self._waiting.remove(fault)
            self._active += 1
            self._timeline.call_after(fault.at, partial(self._happen, fault))

    def cancel_pending(self) -> None:
        """Cancel the faults whose moments were not reached."""
        self._waiting.clear()

    def _happen(self, fault: Fault) -> None:
        self.begun.append((fault, self._timeline.now))
        self._timeline.call_after(fault.lasts, partial(self._end, self._begin(fault)))

    def _end(self, undo: Undo) -> None:
        undo()
        self._active -= 1


def watch_moments(rig: SoakRig, reach: Callable[[Moment], None]) -> None:
    """Call `reach` at each moment of a rig, at once for the start."""
    last: dict[str, Any] = {}

    def watch_status(topic: str, moments: dict[tuple[str, str], Moment]) -> None:
        def watch(_: str, message: Any) -> None:
            before = last.get(topic)
            last[topic] = message
            for (key, value), moment in moments.items():
                if getattr(message, key) == value != getattr(before, key, ""):
                    reach(moment)

        rig.watch(topic, watch)

    def observe_hold(node: str, message: Any) -> None:
        if node != rig.hand_node:
            return
        pressed = last.get(node, False)
        last[node] = message.pressed
        if message.pressed != pressed:
            reach(Moment.PRESSED if message.pressed else Moment.RELEASED)

    watch_status("device/status", _DEVICE)
    watch_status("needle/controller_status", _CONTROLLER)
    rig.watch("device/hold", observe_hold)
    rig.watch("device/joint_trajectory", lambda *_: reach(Moment.COMMAND))
    rig.adapter_opened.append(lambda: reach(Moment.ADAPTER_OPENED))
    reach(Moment.START)


def relative_to_moments(schedule: ScheduleRunner) -> list[Fault]:
    """Return the faults that began, relative to the last moment before each.

    So a change that shifts the events of a run shifts its faults too.
    """
    relative = []
    for fault, begun in schedule.begun:
        last = [one for one in schedule.reached if one.at <= begun][-1]
        relative.append(
            dataclasses.replace(fault, after=last.moment, nth=last.nth, at=begun - last.at)
        )
    return relative
