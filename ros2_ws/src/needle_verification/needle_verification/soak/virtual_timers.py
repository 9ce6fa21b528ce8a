"""Timers and bells of a virtual process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from needle_verification.soak.virtual_world import VirtualProcess


class VirtualTimer:
    """rclpy's Timer: late calls are skipped, not made up for."""

    def __init__(self, process: VirtualProcess, period_ns: int, callback: Any) -> None:
        self._process = process
        self._world = process.world
        self.timer_period_ns = period_ns
        self._callback = callback
        self._canceled = False
        self._due = 0
        self._generation = 0
        self._arm(self._world.steady_ns + period_ns)

    def cancel(self) -> None:
        """Do not call back until `reset`."""
        self._canceled = True

    def reset(self) -> None:
        """Begin the period anew."""
        self._canceled = False
        self._arm(self._world.steady_ns + self.timer_period_ns)

    def _arm(self, due_ns: int) -> None:
        self._due = due_ns
        self._generation += 1
        generation = self._generation

        def call() -> None:
            if generation == self._generation and not self._canceled:
                self._call()

        self._world.call_at(due_ns, lambda: self._process.do(call))

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
