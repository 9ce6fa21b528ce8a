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
from needle_device_driver.cia402.drive_cycle import DriveCycle
from needle_device_driver.cia402.drive_upkeep import are_emulated
from needle_device_driver.device import DeviceInterface
from needle_device_driver.link.frame_link import FrameLink, LinkError
from needle_device_driver.parameters import DriverParameters
from needle_device_driver.procedure import Procedure, Running
from needle_device_driver.supervisor.reports import ServiceResult
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

PERIOD = 0.02
"""Of the cycle: set-points, SYNC, answers [s]."""
_NO_DRIVES = "waiting for the drives"
_REPLY_TIMEOUT = 0.75 * PERIOD
_SEARCH_PERIOD = 0.25
EXIT_BROKEN = 3
"""The cycle raised an error: the axes are no longer controlled."""


class DeviceDriver(Component):
    """Runs the cycle of the drives, and procedures that take several frames.

    Parameters
    ----------
    settings : DriverParameters
        The node's parameters, a `DeviceDriverParameters`.
    name : str
        Name of the node.
    search_from : float
        Steady time of the first search for the drives: discovery of another device takes time [s].

    Attributes
    ----------
    supervisor : MotionSupervisor
        The motion supervisor.
    link : FrameLink
        The bus.
    waiting : str
        Why services are not ready; empty: they are.
    searches : bool
        Whether the driver searches for the drives.
    is_set_up : bool
        Whether the drives are set up, so that cycles run.
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
        self.link = FrameLink(settings.link_name)
        insertion, rotation = (
            Cia402Axis(
                axis, settings.drive(axis), self.link, period=PERIOD, watchdog=settings.watchdog
            )
            for axis in ("insertion", "rotation")
        )
        self._drives = DriveCycle(self.link, (insertion, rotation), PERIOD)
        self.supervisor = MotionSupervisor(
            insertion,
            rotation,
            settings,
            feedback_delay=1,
            is_switching=lambda: self._drives.needs_cycles,
        )
        self._device = DeviceInterface(
            self.supervisor, name, simulated=None, not_ready=lambda: self.waiting
        )
        self.waiting = _NO_DRIVES
        self.searches = True
        self.is_set_up = False
        self._refusal = ""
        self._is_ending = False
        self._search_at, self._give_up_at = search_from, math.inf
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
            Timer(1.0, self._guarded(self._report_health)),
        )

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Check for another device; if there is one before the set-up, exit."""
        yield from self._guarded(self._device.on_peers)(peers, at)
        if self.searches and self._device.conflict:
            yield Exit(EXIT_BAD_INPUT, self._device.conflict)

    def on_stop(self, at: Moment) -> Actions:
        """Stop both axes, switch them off, and exit."""
        return self._guarded(self._shut_down)(at)

    def _guarded(
        self, handler: Callable[..., Actions], *, ends: bool = False
    ) -> Callable[..., Actions]:
        """Wrap a handler: send its frames, and stop both axes if it raises an error.

        Parameters
        ----------
        handler : callable
            Its last argument is the moment.
        ends : bool
            Whether an error also ends the component; the drives then stop without its heartbeat.
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
        frames = self.link.pop_outgoing()
        if frames:
            yield Send(CAN, frames)

    # ---- the cycle ----------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Whether a procedure or a cycle is under way."""
        return self._device.is_busy or self._cycle is not None

    def _on_frames(self, items: Sequence[CanFrame | CanErrors], at: Moment) -> Actions:
        self.link.receive(items)
        yield from self._advance(at)

    def _on_port_change(self, change: PortChange, at: Moment) -> Actions:
        self.link.set_port_error(change.lost)
        yield from self._observe(at)
        yield from self._advance(at)

    def _on_cycle(self, at: Moment) -> Actions:
        self._drives.times.begin(at.steady)
        yield from self._advance(at)
        if self._is_ending:
            return
        if self.is_busy:
            # While a drive is slow, the SDO client sends the heartbeat; supervision must continue.
            yield from self._observe(at)
            yield from self._device.advance(at)
        elif self.is_set_up:
            yield from self._begin_cycle(at)
        elif self.searches and at.steady >= self._search_at:
            self._search_at = at.steady + _SEARCH_PERIOD
            self._give_up_at = min(self._give_up_at, at.steady + self.settings.connect_timeout)
            yield from self._search(at)

    def _observe(self, at: Moment) -> Actions:
        self.supervisor.observe(at.steady)
        yield from self._device.report(at)

    def _begin_cycle(self, at: Moment) -> Actions:
        self.supervisor.note_time(at.stamp_ns, at.steady)
        self._drives.collect()
        self.supervisor.drive(PERIOD, at.steady)
        self._cycle = Running(self._drives.exchange(_REPLY_TIMEOUT)), at
        yield from self._advance(at)

    def _advance(self, at: Moment) -> Actions:
        """Resume the cycle and the procedure under way."""
        if self._cycle is not None:
            running, begun = self._cycle
            if running.advance(at.steady):
                self._cycle = None
                yield from self._finish_cycle(begun, at)
        yield from self._device.advance(at)

    def _finish_cycle(self, begun: Moment, at: Moment) -> Actions:
        if self._is_ending:
            yield from self._exit(at)
            return
        yield from self._observe(at)
        # The drives sampled the joints at the SYNC.
        yield from self._device.joint_states(dataclasses.replace(at, stamp_ns=begun.stamp_ns))

    # ---- begin and end ------------------------------------------------------------------------

    def _search(self, at: Moment) -> Actions:
        """Search for the drives and set them up; moves nothing."""
        self._refusal = ""
        yield from self._device.begin(self._set_up_drives(at.steady), self._after_search, at)

    def _set_up_drives(self, now: float) -> Procedure[ServiceResult]:
        error = yield from self._drives.probe()
        if error:
            return ServiceResult(False, error)
        if self.supervisor.state is not State.UNCONFIGURED:
            # Clear an earlier fault; an emergency stop that is pressed stays.
            result = yield from self.supervisor.reset(now)
            if not result.success:
                return result
        nodes = [self.settings.drive(name).node_id for name in ("insertion", "rotation")]
        try:
            self._device.simulated = yield from are_emulated(self.link, nodes)
        except LinkError as lost:
            return ServiceResult(False, str(lost))
        result = yield from self.supervisor.configure(now)
        # A drive that refuses its set-up will refuse the next attempt, too.
        self._refusal = "" if result.success else result.message
        return result

    def _after_search(self, result: ServiceResult, at: Moment) -> Actions:
        if result.success:
            self.is_set_up, self.searches, self.waiting = True, False, ""
            yield Log("info", f"found both drives on {self.link.name}")
            for text in self._drives.missing_optional_objects:
                # Feed the watchdogs: logging can be slow.
                self._drives.beat()
                yield from self._send()
                yield Log("warning", text)
        elif self._refusal or at.steady > self._give_up_at:
            yield Exit(EXIT_BAD_INPUT, result.message)
        elif not self.waiting.endswith(result.message):
            self.waiting = f"waiting for the drives: {result.message}"
            yield Log("info", self.waiting)

    def _shut_down(self, at: Moment) -> Actions:
        self._is_ending, self.is_set_up, self.searches = True, False, False
        self.waiting = _NO_DRIVES
        yield from self._device.cancel("shutting down", at)
        if self._cycle is not None:
            self._cycle[0].cancel()
        self._cycle = Running(self.supervisor.deconfigure()), at
        yield from self._advance(at)

    def _exit(self, at: Moment) -> Actions:
        self._is_ending = False
        self._device.simulated = None
        yield from self._device.report(at)
        yield from self._send()
        self.link.close()
        yield Exit(EXIT_DONE)

    def _report_health(self, at: Moment) -> Actions:
        yield Diagnose("can", self._drives.health(self.waiting))
