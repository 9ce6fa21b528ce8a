"""device_driver as a component: the `device/...` interface on drives behind a CAN port."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

from needle_core.can_frame import CAN, CanErrors, CanFrame
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
from needle_device_driver.cia402.cycle_times import CycleTimes
from needle_device_driver.cia402.drive_cycle import DriveCycle
from needle_device_driver.cia402.drive_identity import are_emulated
from needle_device_driver.device import DeviceRows
from needle_device_driver.link.frame_link import FrameLink, LinkError
from needle_device_driver.parameters import DriverParameters
from needle_device_driver.procedure import Procedure, Running
from needle_device_driver.supervisor.reports import Reply
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

PERIOD = 0.02
"""Of the cycle: set-points, SYNC, answers [s]."""
_NO_DRIVES = "waiting for the drives"
_REPLY_WAIT = 0.75 * PERIOD
_RETRY = 0.25
EXIT_BROKEN = 3
"""The cycle itself failed: nobody drives the axes any more."""

Then = Callable[[Reply, Moment], Actions]


class DeviceDriver(Component):
    """Runs the cycle and the orders that take several frames; waits for no drive.

    Parameters
    ----------
    settings : DriverParameters
        The node's parameters, a `DeviceDriverParameters`.
    name : str
        How it signs what it says.
    search_from : float
        Steady time of the first look for the drives: another device shows itself before [s].

    Attributes
    ----------
    supervisor : MotionSupervisor
        What the rows speak for.
    link : FrameLink
        The bus.
    waiting : str
        What services wait for; empty: nothing.
    is_set_up : bool
        Whether cycles run.
    """

    name = "device_driver"

    def __init__(
        self,
        settings: DriverParameters,
        name: str = name,
        *,
        search_from: float = 0.0,
    ) -> None:
        self.settings = settings
        self.link = FrameLink(settings.link_settings)
        insertion, rotation = (
            Cia402Axis(
                axis, settings.drive(axis), self.link, period=PERIOD, watchdog=settings.watchdog
            )
            for axis in ("insertion", "rotation")
        )
        self._drives = DriveCycle(self.link, (insertion, rotation))
        self.supervisor = MotionSupervisor(
            insertion,
            rotation,
            settings.limits,
            feedback_delay=1,
            switching=lambda: self._drives.needs_cycles,
        )
        self._device = DeviceRows(
            self.supervisor, name, simulated=None, refuse=lambda: self.waiting
        )
        self.waiting = _NO_DRIVES
        self.searches = True
        self.is_set_up = False
        self._refusal = ""
        self._times = CycleTimes(PERIOD)
        self._is_ending = False
        self._retry_at, self._give_up_at = search_from, math.inf
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
        if self.searches and self._device.others:
            yield Exit(EXIT_BAD_INPUT, self._device.others)

    def on_stop(self, at: Moment) -> Actions:
        """Stop both axes, switch them off, and exit."""
        return self._guarded(self._take_down)(at)

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
            self.link.now = at.steady
            try:
                yield from handler(*arguments)
            except Exception as error:
                text = f"internal error: {type(error).__name__}: {error}"
                self.supervisor.fail(text)
                yield from self._device.report(at)
                yield from self._send()
                if ends:
                    yield Exit(EXIT_BROKEN, text)
                raise
            yield from self._send()

        return guarded

    def _send(self) -> Actions:
        frames = self.link.take_sent()
        if frames:
            yield Send(CAN, frames)

    # ---- the cycle ----------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Tell whether an order or a cycle is under way."""
        return self._device.is_busy or self._cycle is not None

    def _on_frames(self, items: Sequence[CanFrame | CanErrors], at: Moment) -> Actions:
        self.link.receive(items)
        yield from self._go_on(at)

    def _on_port_change(self, change: PortChange, at: Moment) -> Actions:
        self.link.change(change.lost)
        self.supervisor.observe(at.steady)
        yield from self._device.report(at)
        yield from self._go_on(at)

    def _on_cycle(self, at: Moment) -> Actions:
        self._times.begin(at.steady)
        yield from self._go_on(at)
        if self._is_ending:
            return
        if self.is_busy:
            # A drive takes its time, and the SDO client sends the heartbeat: the rest goes on, too.
            yield from self._observe(at)
            yield from self._device.advance(at)
        elif self.is_set_up:
            yield from self._begin_cycle(at)
        elif self.searches and at.steady >= self._retry_at:
            self._retry_at = at.steady + _RETRY
            self._give_up_at = min(self._give_up_at, at.steady + self.settings.connect_timeout)
            yield from self.set_up(self._after_search, at)

    def _observe(self, at: Moment) -> Actions:
        self.supervisor.observe(at.steady)
        yield from self._device.report(at)

    def _begin_cycle(self, at: Moment) -> Actions:
        self.supervisor.note_time(at.stamp_ns, at.steady)
        self._drives.collect()
        self.supervisor.drive(PERIOD, at.steady)
        self._cycle = Running(self._drives.exchange(_REPLY_WAIT)), at
        yield from self._go_on(at)

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
            yield from self._leave(at)
            return
        self.supervisor.observe(at.steady)
        yield from self._device.report(at)
        # The drives sampled them at the SYNC.
        yield from self._device.joint_states(dataclasses.replace(at, stamp_ns=begun.stamp_ns))

    # ---- begin and end ------------------------------------------------------------------------

    def set_up(self, then: Then, at: Moment) -> Actions:
        """Look for the drives and set them up; moves nothing. `then` gets the outcome."""
        self._refusal = ""

        def after(reply: Reply, at: Moment) -> Actions:
            if reply.success:
                self.is_set_up, self.searches, self.waiting = True, False, ""
                yield Log("info", f"both drives are there on {self.settings.link_settings}")
                for text in self._drives.missing_optional_objects:
                    # Many words take longer than a watchdog waits.
                    self._drives.beat()
                    yield from self._send()
                    yield Log("warning", text)
            yield from then(reply, at)

        yield from self._device.begin(self._setting_up(at.steady), after, at)

    def _setting_up(self, now: float) -> Procedure[Reply]:
        why_not = yield from self._drives.probe()
        if why_not:
            return Reply(False, why_not)
        if self.supervisor.state is not State.UNCONFIGURED:
            # A fault from before; an emergency stop that is pressed stays.
            reply = yield from self.supervisor.reset(now)
            if not reply.success:
                return reply
        nodes = [self.settings.drive(name).node_id for name in ("insertion", "rotation")]
        try:
            self._device.simulated = yield from are_emulated(self.link, nodes)
        except LinkError as error:
            return Reply(False, str(error))
        reply = yield from self.supervisor.configure(now)
        # Drives that are there may refuse: asking again would not help.
        self._refusal = "" if reply.success else reply.message
        return reply

    def _after_search(self, reply: Reply, at: Moment) -> Actions:
        if reply.success:
            return
        if self._refusal or at.steady > self._give_up_at:
            yield Exit(EXIT_BAD_INPUT, reply.message)
        elif not self.waiting.endswith(reply.message):
            self.waiting = f"waiting for the drives: {reply.message}"
            yield Log("info", self.waiting)

    def _take_down(self, at: Moment) -> Actions:
        self._is_ending, self.is_set_up, self.searches = True, False, False
        self.waiting = _NO_DRIVES
        yield from self._device.call_off("the driver ends", at)
        if self._cycle is not None:
            self._cycle[0].cancel()
        self._cycle = Running(self.supervisor.deconfigure()), at
        yield from self._go_on(at)

    def _leave(self, at: Moment) -> Actions:
        self._is_ending = False
        self._device.simulated = None
        yield from self._device.report(at)
        yield from self._send()
        self.link.close()
        yield Exit(EXIT_DONE)

    def _tell_health(self, at: Moment) -> Actions:
        yield Diagnose("can", self._drives.health(self.waiting, self._times.take()))
