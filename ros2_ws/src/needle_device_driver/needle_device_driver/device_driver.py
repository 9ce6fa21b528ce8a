"""device_driver as a component: the `device/...` interface on drives behind ports."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERNAL_ERROR
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
from needle_device_driver.axes.axis import PERIOD, Axis
from needle_device_driver.axes.drives import Drives
from needle_device_driver.axes.link import LinkError
from needle_device_driver.device import DeviceInterface
from needle_device_driver.parameters import DriverParameters
from needle_device_driver.procedure import Procedure, Running, side_by_side
from needle_device_driver.supervisor.reports import ServiceResult
from needle_device_driver.supervisor.states import State
from needle_device_driver.supervisor.supervisor import MotionSupervisor

_NO_DRIVES = "waiting for the drives"
_REPLY_TIMEOUT = 0.75 * PERIOD
_SEARCH_PERIOD = 0.25
# A cycle is late if its delay exceeds this share of a period.
_LATE = 0.5


class CycleTimes:
    """Measures whether cycles begin on time."""

    def __init__(self) -> None:
        self._begun: float | None = None
        self._longest = 0.0
        self._late = 0

    def begin(self, now: float) -> None:
        """Note that a cycle begins at steady time `now` [s]."""
        if self._begun is not None:
            between = now - self._begun
            self._longest = max(self._longest, between)
            self._late += between > (1.0 + _LATE) * PERIOD
        self._begun = now

    def pop_figures(self) -> dict[str, str]:
        """Return the number of late cycles, and the longest cycle since the last call."""
        longest, self._longest = self._longest, 0.0
        return {"late_cycles": str(self._late), "longest_cycle_s": f"{longest:.4f}"}


class DeviceDriver(Component):
    """Runs the cycle of the drives, and procedures that take several frames.

    Parameters
    ----------
    settings : DriverParameters
        The node's parameters, a `DeviceDriverParameters`.
    name : str
        Name of the node.
    search_from : float
        Steady time of the first search for the drives [s]; discovering another device takes time.

    Attributes
    ----------
    supervisor : MotionSupervisor
        The motion supervisor.
    drives : tuple of Drives
        Each kind of drive in use.
    waiting : str
        Reason why services are not ready; empty: ready.
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
        self.drives: tuple[Drives, ...] = tuple(
            backend.make(settings, settings.axes_of(backend)) for backend in settings.backends
        )
        self._times = CycleTimes()
        axes: dict[str, Axis] = {}
        for drives in self.drives:
            axes |= drives.axes
        response_time = max(drives.capabilities.response_time for drives in self.drives)
        self.supervisor = MotionSupervisor(
            axes["insertion"],
            axes["rotation"],
            settings,
            feedback_delay=math.ceil(response_time / PERIOD),
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
        self.ports = tuple(
            Port(
                drives.port,
                self._guarded(partial(self._on_batch, drives)),
                self._guarded(partial(self._on_port_change, drives)),
            )
            for drives in self.drives
        )
        self.timers = (
            Timer(PERIOD, self._guarded(self._on_cycle, ends=True)),
            Timer(1.0, self._guarded(self._report_health)),
        )

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Check for another device; if there is one before the set-up, exit."""
        yield from self._guarded(self._device.on_peers)(peers, at)
        if self.searches and self.supervisor.conflict:
            yield Exit(EXIT_BAD_INPUT, self.supervisor.conflict)

    def on_stop(self, at: Moment) -> Actions:
        """Stop both axes, switch them off, and exit."""
        return self._guarded(self._shut_down)(at)

    def _guarded(
        self, handler: Callable[..., Actions], *, ends: bool = False
    ) -> Callable[..., Actions]:
        """Wrap a handler: send its orders, and stop both axes if it raises an error.

        Parameters
        ----------
        handler : callable
            Handler whose last argument is the moment.
        ends : bool
            Whether an error also ends the component; without its heartbeat, the drives then stop.
        """

        def guarded(*arguments: Any) -> Actions:
            at: Moment = arguments[-1]
            for drives in self.drives:
                drives.link.now = at.steady
            try:
                yield from handler(*arguments)
            except Exception as error:
                text = f"internal error: {type(error).__name__}: {error}"
                self.supervisor.fail(text)
                yield from self._device.report(at)
                yield from self._send()
                if ends:
                    yield Exit(EXIT_INTERNAL_ERROR, text)
                raise
            yield from self._send()

        return guarded

    def _send(self) -> Actions:
        for drives in self.drives:
            if batch := drives.link.pop_outgoing():
                yield Send(drives.port, batch)

    # ---- the cycle ----------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Whether a procedure or a cycle is under way."""
        return self._device.is_busy or self._cycle is not None

    def _on_batch(self, drives: Drives, batch: Sequence[Any], at: Moment) -> Actions:
        drives.receive(batch)
        yield from self._advance(at)

    def _on_port_change(self, drives: Drives, change: PortChange, at: Moment) -> Actions:
        drives.link.set_port_error(change.lost)
        yield from self._observe(at)
        yield from self._advance(at)

    def _on_cycle(self, at: Moment) -> Actions:
        self._times.begin(at.steady)
        yield from self._advance(at)
        if self._is_ending:
            return
        if self.is_busy:
            # A procedure feeds the watchdogs of its own drives only. Supervision must continue.
            if len(self.drives) > 1:
                self._beat()
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
        for drives in self.drives:
            drives.collect()
        self.supervisor.drive(PERIOD, at.steady)
        exchanges = (drives.exchange(_REPLY_TIMEOUT) for drives in self.drives)
        self._cycle = Running(side_by_side(*exchanges)), at
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
        for drives in self.drives:
            error = yield from drives.probe()
            if error:
                return ServiceResult(False, error)
        if self.supervisor.state is not State.UNCONFIGURED:
            # Clear an earlier fault; a pressed emergency stop remains.
            result = yield from self.supervisor.reset(now)
            if not result.success:
                return result
        simulated = True
        for drives in self.drives:
            try:
                emulated = yield from drives.are_emulated()
            except LinkError as lost:
                return ServiceResult(False, str(lost))
            simulated = simulated and emulated
        self._device.simulated = simulated
        result = yield from self.supervisor.configure(now)
        # A drive that refuses its set-up will refuse the next attempt, too.
        self._refusal = "" if result.success else result.message
        return result

    def _after_search(self, result: ServiceResult, at: Moment) -> Actions:
        if result.success:
            self.is_set_up, self.searches, self.waiting = True, False, ""
            yield Log(
                "info",
                f"found both drives on {' and '.join(drives.link.name for drives in self.drives)}",
            )
            for text in (text for drives in self.drives for text in drives.missing_optional_parts):
                # Feed the watchdogs: logging can be slow.
                self._beat()
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
        for drives in self.drives:
            drives.link.close()
        yield Exit(EXIT_DONE)

    def _beat(self) -> None:
        for drives in self.drives:
            drives.beat()

    def _report_health(self, at: Moment) -> Actions:
        times = self._times.pop_figures()
        for drives in self.drives:
            health = drives.health(self.waiting)
            values = {**health.values, **times}
            yield Diagnose(drives.port, dataclasses.replace(health, values=values))
