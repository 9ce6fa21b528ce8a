"""device_driver as a component: the `device/...` interface on drives behind a CAN port."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

from needle_core.can_frame import CAN, CanFrame
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE
from needle_core.component import (
    Actions,
    Component,
    Diagnose,
    Exit,
    Log,
    Moment,
    Peers,
    Port,
    PortChange,
    Send,
    Timer,
)
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_cycle import DriveCycle
from needle_device_driver.cia402.drive_identity import are_emulated
from needle_device_driver.device import DeviceRows
from needle_device_driver.link.port_link import PortLink
from needle_device_driver.parameters import DriverParameters
from needle_device_driver.procedure import Procedure, Running
from needle_device_driver.supervisor.reports import Reply
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

PERIOD = 0.02
"""Of the cycle: set-points, SYNC, answers [s]."""
_REPLY_WAIT = 0.75 * PERIOD
_RETRY = 0.25
EXIT_BROKEN = 3
"""The cycle itself failed: nobody drives the axes any more."""


class DeviceDriver(Component):
    """Runs the cycle and the orders that take several frames; waits for no drive.

    Parameters
    ----------
    settings : DriverParameters
        The node's parameters, a `DeviceDriverParameters`.
    """

    name = "device_driver"

    def __init__(self, settings: DriverParameters) -> None:
        self.settings = settings
        self._link = PortLink(settings.link_settings)
        insertion, rotation = (
            Cia402Axis(
                name, settings.drive(name), self._link, period=PERIOD, watchdog=settings.watchdog
            )
            for name in ("insertion", "rotation")
        )
        self._drives = DriveCycle(self._link, (insertion, rotation))
        self._supervisor = MotionSupervisor(
            insertion,
            rotation,
            settings.limits,
            feedback_delay=1,
            switching=lambda: self._drives.needs_cycles,
        )
        self._device = DeviceRows(
            self._supervisor, self.name, simulated=None, refuse=lambda: self._waiting
        )
        self._waiting = "waiting for the driver to be activated"
        self._searches = settings.autostart
        self._refusal = ""
        self._is_set_up = self._is_ending = False
        self._retry_at, self._give_up_at = 0.0, math.inf
        self._cycle: tuple[Running[Any], Moment] | None = None
        self.inputs = tuple(
            dataclasses.replace(row, handler=self._guarded(row.handler))
            for row in self._device.inputs
        )
        self.services = tuple(
            dataclasses.replace(row, handler=self._guarded(row.handler))
            for row in self._device.services
        )
        self.outputs = self._device.outputs
        self.ports = (
            Port(CAN, self._guarded(self._on_frames), self._guarded(self._on_port_change)),
        )
        self.timers = (
            Timer(PERIOD, self._guarded(self._on_cycle, ends=True)),
            Timer(1.0, self._guarded(self._tell_health)),
        )

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note who else is a device here; with another one nothing begins."""
        yield from self._guarded(self._device.on_peers)(peers, at)
        if self._searches and self._device.others:
            yield Exit(EXIT_BAD_INPUT, self._device.others)

    def on_stop(self, at: Moment) -> Actions:
        """Stop both axes, switch them off, and exit."""
        return self._guarded(self._end)(at)

    def _guarded(
        self, handler: Callable[..., Actions], *, ends: bool = False
    ) -> Callable[..., Actions]:
        """Return a handler that sends its frames; one that raises stops both axes.

        Parameters
        ----------
        handler : callable
            Its last argument is the moment.
        ends : bool
            Whether the component ends if it raises: drives that hear no heartbeat stop.
        """

        def guarded(*arguments: Any) -> Actions:
            at: Moment = arguments[-1]
            self._link.now = at.steady
            try:
                yield from handler(*arguments)
            except Exception as error:
                text = f"internal error: {type(error).__name__}: {error}"
                self._supervisor.fail(text)
                yield from self._device.report(at)
                yield from self._send()
                if ends:
                    yield Exit(EXIT_BROKEN, text)
                raise
            yield from self._send()

        return guarded

    def _send(self) -> Actions:
        frames = self._link.take_sent()
        if frames:
            yield Send(CAN, frames)

    # ---- the cycle ----------------------------------------------------------------------------

    def _on_frames(self, frames: Sequence[CanFrame], at: Moment) -> Actions:
        self._link.receive(frames)
        yield from self._go_on(at)

    def _on_port_change(self, change: PortChange, at: Moment) -> Actions:
        self._link.change(change.lost)
        self._supervisor.observe(at.steady)
        yield from self._device.report(at)
        yield from self._go_on(at)

    def _on_cycle(self, at: Moment) -> Actions:
        yield from self._go_on(at)
        if self._is_ending:
            return
        if self._device.is_busy or self._cycle is not None:
            # A drive takes its time, and the SDO client sends the heartbeat: the rest goes on, too.
            self._supervisor.observe(at.steady)
            yield from self._device.report(at)
            yield from self._device.advance(at)
        elif self._is_set_up:
            self._supervisor.note_time(at.stamp_ns, at.steady)
            self._drives.collect()
            self._supervisor.drive(PERIOD, at.steady)
            self._cycle = Running(self._drives.exchange(_REPLY_WAIT)), at
            yield from self._go_on(at)
        elif self._searches and at.steady >= self._retry_at:
            self._retry_at = at.steady + _RETRY
            self._give_up_at = min(self._give_up_at, at.steady + self.settings.connect_timeout)
            yield from self._device.begin(self._setting_up(at.steady), self._on_set_up, at)

    def _go_on(self, at: Moment) -> Actions:
        """Go on with what is under way, as far as it goes."""
        if self._cycle is not None:
            running, begun = self._cycle
            if running.advance(at.steady):
                self._cycle = None
                yield from self._finish_cycle(begun, at)
        yield from self._device.advance(at)

    def _finish_cycle(self, begun: Moment, at: Moment) -> Actions:
        if self._is_ending:
            self._link.close()
            yield from self._send()
            yield Exit(EXIT_DONE)
            return
        self._supervisor.observe(at.steady)
        yield from self._device.report(at)
        # The drives sampled them at the SYNC.
        yield from self._device.joint_states(dataclasses.replace(at, stamp_ns=begun.stamp_ns))

    # ---- begin and end ------------------------------------------------------------------------

    def _setting_up(self, now: float) -> Procedure[Reply]:
        """Look for the drives and set them up; moves nothing. Ones that are there may refuse."""
        why_not = yield from self._drives.probe()
        if why_not:
            return Reply(False, why_not)
        if self._supervisor.state is not State.UNCONFIGURED:
            # A fault from before; an emergency stop that is pressed stays.
            reply = yield from self._supervisor.resetting(now)
            if not reply.success:
                return reply
        nodes = [self.settings.drive(name).node_id for name in ("insertion", "rotation")]
        self._device.simulated = yield from are_emulated(self._link, nodes)
        reply = yield from self._supervisor.configuring(now)
        self._refusal = "" if reply.success else reply.message
        return reply

    def _on_set_up(self, reply: Reply, at: Moment) -> Actions:
        if reply.success:
            self._is_set_up, self._searches, self._waiting = True, False, ""
            yield Log("info", f"both drives are there on {self.settings.link_settings}")
            for text in self._drives.missing_optional_objects:
                yield Log("warning", text)
        elif self._refusal or at.steady > self._give_up_at:
            yield Exit(EXIT_BAD_INPUT, reply.message)
        elif not self._waiting.endswith(reply.message):
            self._waiting = f"waiting for the drives: {reply.message}"
            yield Log("info", self._waiting)

    def _end(self, at: Moment) -> Actions:
        self._is_ending, self._waiting = True, "the driver ends"
        yield from self._device.call_off("the driver ends", at)
        if self._cycle is not None:
            self._cycle[0].cancel()
        self._cycle = Running(self._supervisor.deconfiguring()), at
        yield from self._go_on(at)

    def _tell_health(self, at: Moment) -> Actions:
        yield Diagnose("can", self._drives.health(self._waiting))
