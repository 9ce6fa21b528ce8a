"""Alarms, timers and bells of a virtual process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from needle_verification.soak.virtual_world import VirtualProcess, VirtualWorld


class VirtualAlarm:
    """Goes off once when it is due; set anew, it forgets when it was due before.

    Parameters
    ----------
    world : VirtualWorld
        Its time.
    run : callable
        Runs what is due: the process' `do`, or `do_concurrently` as beside its thread.
    action : callable
        What is due.
    """

    def __init__(
        self,
        world: VirtualWorld,
        run: Callable[[Callable[[], None]], None],
        action: Callable[[], None],
    ) -> None:
        self._world = world
        self._run = run
        self._action = action
        self._count = 0

    def set(self, due_ns: int) -> None:
        """Go off when the steady clock shows `due_ns` [ns]."""
        self._count += 1
        this = self._count

        def go_off() -> None:
            if this == self._count:
                self._action()

        self._world.call_at(due_ns, lambda: self._run(go_off))

    def cancel(self) -> None:
        """Do not go off until it is set again."""
        self._count += 1


class VirtualTimer:
    """rclpy's Timer: late calls are skipped, not made up for."""

    def __init__(self, process: VirtualProcess, period_ns: int, callback: Any) -> None:
        self._world = process.world
        self.timer_period_ns = period_ns
        self._callback = callback
        self._alarm = VirtualAlarm(self._world, process.do, self._call)
        self._due = 0
        self.reset()

    def cancel(self) -> None:
        """Do not call back until `reset`."""
        self._alarm.cancel()

    def reset(self) -> None:
        """Begin the period anew."""
        self._arm(self._world.steady_ns + self.timer_period_ns)

    def _arm(self, due_ns: int) -> None:
        self._due = due_ns
        self._alarm.set(due_ns)

    def _call(self) -> None:
        behind = self._world.steady_ns - self._due
        self._arm(self._due + self.timer_period_ns * (1 + behind // self.timer_period_ns))
        self._callback()


class VirtualBell:
    """rclpy's GuardCondition: however often it is rung before it is heard, it is heard once."""

    def __init__(self, process: VirtualProcess, callback: Callable[[], None]) -> None:
        self._process = process
        self._callback = callback
        self._rung = False

    def trigger(self) -> None:
        """Have it called back, by any thread."""
        if not self._rung:
            self._rung = True
            self._process.do(self._hear)

    def _hear(self) -> None:
        self._rung = False
        self._callback()
