"""The schedule of a schedule: each fault begins by what it meets, and ends after its time."""

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
# What it is when a field of a status becomes another.
_DEVICE = {
    ("activity", "homing"): Moment.HOMING,
    ("state", "HOLDING"): Moment.HOLDING,
    ("state", "MOVING"): Moment.MOVING,
    ("state", "FAULT"): Moment.FAULT,
}
_CONTROLLER = {("state", "STEERING"): Moment.STEERING, ("state", "DONE"): Moment.DONE}


@dataclasses.dataclass(frozen=True)
class ReachedMoment:
    """A moment that came.

    Attributes
    ----------
    moment : Moment
        Which.
    nth : int
        For the how manyth time, from 1.
    at : float
        When [s].
    """

    moment: Moment
    nth: int
    at: float


class ScheduleRunner:
    """Lets the faults of a schedule begin and end.

    Parameters
    ----------
    timeline : Timeline
        Its clock.
    faults : sequence of Fault
        The schedule.
    begin : callable
        Lets a fault begin, and returns what ends it.

    Attributes
    ----------
    reached : list of ReachedMoment
        All moments that came, in their order.
    begun : list of tuple of Fault and float
        Faults that happened, and when they began [s].
    """

    def __init__(
        self, timeline: Timeline, faults: Sequence[Fault], begin: Callable[[Fault], Undo]
    ) -> None:
        self._timeline = timeline
        self._begin = begin
        self._waiting = list(faults)
        self._under_way = 0
        self._count: Counter[Moment] = Counter()
        self.reached: list[ReachedMoment] = []
        self.begun: list[tuple[Fault, float]] = []

    @property
    def has_active(self) -> bool:
        """Whether a fault lasts, or its moment has come."""
        return self._under_way > 0

    @property
    def has_pending(self) -> bool:
        """Whether the moment of a fault has not come yet."""
        return bool(self._waiting)

    def reach(self, moment: Moment) -> None:
        """Take note that a moment has come."""
        self._count[moment] += 1
        this = moment, self._count[moment]
        self.reached.append(ReachedMoment(*this, self._timeline.now))
        for fault in [one for one in self._waiting if (one.after, one.nth) == this]:
            self._waiting.remove(fault)
            self._under_way += 1
            self._timeline.call_after(fault.at, partial(self._happen, fault))

    def cancel_pending(self) -> None:
        """Wait for no moment any more."""
        self._waiting.clear()

    def _happen(self, fault: Fault) -> None:
        self.begun.append((fault, self._timeline.now))
        self._timeline.call_after(fault.lasts, partial(self._end, self._begin(fault)))

    def _end(self, undo: Undo) -> None:
        undo()
        self._under_way -= 1


def watch_moments(rig: SoakRig, reach: Callable[[Moment], None]) -> None:
    """Call `reach` with each moment of a rig as it comes, the start at once."""
    heard: dict[str, Any] = {}

    def watch_status(topic: str, moments: dict[tuple[str, str], Moment]) -> None:
        def see(_: str, message: Any) -> None:
            before = heard.get(topic)
            heard[topic] = message
            for (key, value), moment in moments.items():
                if getattr(message, key) == value != getattr(before, key, ""):
                    reach(moment)

        rig.watch(topic, see)

    def observe_hold(node: str, message: Any) -> None:
        if node != rig.hand_node:
            return
        pressed = heard.get(node, False)
        heard[node] = message.pressed
        if message.pressed != pressed:
            reach(Moment.PRESSED if message.pressed else Moment.RELEASED)

    watch_status("device/status", _DEVICE)
    watch_status("needle/controller_status", _CONTROLLER)
    rig.watch("device/hold", observe_hold)
    rig.watch("device/joint_trajectory", lambda *_: reach(Moment.COMMAND))
    rig.adapter_opened.append(lambda: reach(Moment.ADAPTER_OPENED))
    reach(Moment.START)


def relative_to_moments(schedule: ScheduleRunner) -> list[Fault]:
    """Return the faults that happened, each told by the last moment that it met.

    So a change that shifts what a run does shifts its faults with it.
    """
    told = []
    for fault, begun in schedule.begun:
        last = [one for one in schedule.reached if one.at <= begun][-1]
        told.append(dataclasses.replace(fault, after=last.moment, nth=last.nth, at=begun - last.at))
    return told
