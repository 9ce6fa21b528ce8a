"""sim_rig's own device at levels tip and camera: the motion supervisor on simulated axes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.subscription import Subscription

from needle_core.component import Moment
from needle_core.errors import UserError
from needle_core.ros.base_node import DiagnosticsPublisher
from needle_core.ros.discovery import signature
from needle_device_driver.device import COMMANDS, HOLD, DeviceRows
from needle_device_driver.procedure import run_at_once
from needle_device_driver.ros.device_interface import DeviceInterface
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.states import Activity
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.rig.bench import SimulatedBench
from needle_sim.rig.simulated_axis import SimulatedAxis


class SimulatedDevice:
    """Answers to `device/...` and moves the bench.

    Parameters
    ----------
    node : Node
        Gets the interface.
    diagnostics : DiagnosticsPublisher
        Where the device's health goes.
    bench : SimulatedBench
        What is moved.
    limits : SafetyLimits
        The supervisor's.
    in_lock_step : bool
        A hold that falls silent pauses instead of aborting.
    path_delay : float
        In lock step a path takes effect so long after its tip's exposure [s].
    refuse : callable
        Returns why services are not ready yet; empty when they are.
    on_step_end : callable
        Called after each result.
    now : float
        Steady time [s].

    Attributes
    ----------
    publishers : list of Publisher
        Topics that partners must listen to.
    subscriptions : list of Subscription
        Topics that partners must publish.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: DiagnosticsPublisher,
        bench: SimulatedBench,
        limits: SafetyLimits,
        *,
        in_lock_step: bool,
        path_delay: float,
        refuse: Callable[[], str],
        on_step_end: Callable[[], None],
        now: float,
    ) -> None:
        self._bench = bench
        self._insertion = SimulatedAxis("insertion")
        self._rotation = SimulatedAxis("rotation")
        self._supervisor = MotionSupervisor(
            self._insertion,
            self._rotation,
            limits,
            lock_step=in_lock_step,
            path_delay=path_delay,
        )
        run_at_once(self._supervisor.configure(now))
        self._rows = DeviceRows(self._supervisor, signature(node), simulated=True)
        self._interface = interface = DeviceInterface(
            node, self._rows, diagnostics, refuse=refuse, on_step_end=on_step_end
        )
        self.publishers = interface.publishers
        self.subscriptions: list[Subscription[Any]] = [
            interface.subscription(COMMANDS),
            interface.subscription(HOLD),
        ]
        self._report()

    def missing(self) -> list[str]:
        """Return what else is not there yet: nothing.

        Raises
        ------
        UserError
            If there is another device.
        """
        self._interface.look_around()
        if self._rows.others:
            raise UserError(self._rows.others)
        return []

    def observe(self, now: float) -> None:
        """Look at axes and hold."""
        self._supervisor.observe(now)

    def under_way(self) -> bool:
        """Return whether a step, retraction or homing is under way."""
        return self._supervisor.activity is not Activity.NONE

    def may_move(self, now: float) -> bool:
        """Return whether it would go on if time did."""
        return self._supervisor.may_move(now)

    def held(self, now: float) -> bool:
        """Return whether somebody's hold counts, and was heard of late."""
        return self._supervisor.held(now)

    def heard_command(self) -> int:
        """Return the stamp of the newest command that the device has heard [ns]."""
        return self._supervisor.command_ns

    def begin_tick(self, time_ns: int, period: float, now: float) -> None:
        """Let `period` [s] go by that ends at `time_ns` [ns]."""
        self._supervisor.note_time(time_ns, now)
        self._supervisor.drive(period, now)
        self._insertion.advance(period)
        self._rotation.advance(period)
        self._bench.move_to(self._insertion.position, self._rotation.position)
        self._supervisor.observe(now)

    def end_tick(self, time_ns: int, now: float) -> bool:
        """Tell what the tick came to; returns whether it is over."""
        # Of the tick, whose joints stay what they are however long this process stood still in it.
        self._tell_joints(time_ns, now)
        self._report()
        return True

    @property
    def patience(self) -> float:
        """Longest wait for callbacks while a tick is under way [s]: it never is."""
        return 0.0

    def idle(self, time_ns: int, now: float, *, repeat: bool) -> None:
        """Look after the device while time stands still.

        Parameters
        ----------
        time_ns : int
            The time [ns].
        now : float
            Steady time [s].
        repeat : bool
            Whether somebody may have missed the joints.
        """
        self._supervisor.note_time(time_ns, now)
        self._report()
        if repeat:
            self._tell_joints(time_ns, now)

    def count_watchdog_trip(self) -> None:
        """Count a watchdog of sim_rig's."""
        self._supervisor.count_watchdog_trip()

    def end_run(self, reason: str) -> None:
        """Stop both axes for good."""
        self._supervisor.fail(reason)

    def close(self) -> None:
        """Stop the simulated axes and say so."""
        run_at_once(self._supervisor.deconfigure())
        self._report()
        self._interface.close()

    def _report(self) -> None:
        self._interface.do(self._rows.report(self._interface.moment()))

    def _tell_joints(self, time_ns: int, now: float) -> None:
        self._interface.do(self._rows.joint_states(Moment(now, time_ns)))
