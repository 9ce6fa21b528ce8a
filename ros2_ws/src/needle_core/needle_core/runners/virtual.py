"""Runner of components in one process on a virtual clock; equal seeds give bit-identical runs.

An event heap holds deliveries, timers and answers. Each delivery has a latency and each handler a
compute time, both random. Every link and every handler has its own random stream, so that adding a
component changes no other draw. While a component computes, its inputs wait in queues with the
depth of their QoS.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from needle_core.component import (
    ANSWER_TIMEOUT,
    Action,
    Answer,
    Call,
    Component,
    Diagnose,
    Exit,
    Input,
    Log,
    Output,
    Peers,
    Port,
    PortChange,
    Publish,
    Reply,
    Send,
    Service,
    Timer,
)
from needle_core.diagnostics import Diagnostic
from needle_core.messages import Diagnostics, LogLine, Status
from needle_core.runners.process import Compute, Process, uniform
from needle_core.runners.timeline import Timeline
from needle_core.runners.transport import Fault, Link, Transport

DIAGNOSTICS = Output("/diagnostics", Diagnostics)
LOG = Output("/rosout", LogLine)
LATENCY = (0.3e-3, 1.5e-3)
"""Delay of a delivery, as between processes on one computer [s]."""
PORT_LATENCY = (0.15e-3, 0.6e-3)
"""Delay of a batch between ports, adapter included [s]."""
COMPUTE = (0.1e-3, 0.3e-3)
"""Default compute time of a handler [s]."""
DISCOVERY = (0.02, 0.2)
"""Time until one component discovers another [s]."""
LEASE = 8.0
"""Time after which the other components drop a killed one [s]."""
_DIAGNOSTICS_PERIOD = 1.0

Tap = Callable[[int, str, Any, Output], None]
"""Called for each publication, before any fault, with stamp [ns], sender, message, output."""


class VirtualRunner:
    """Runs components on an event heap.

    Parameters
    ----------
    components : iterable of Component
        Components, each run as its own process.
    seed : int
        Seed of latencies and compute times.
    compute : mapping of str to Compute
        Compute times of the handlers by component; `COMPUTE` by default.
    faults : sequence of Fault
        Faults, applied to each delivery in order.
    taps : sequence of Tap
        Callbacks for every publication.

    Attributes
    ----------
    timeline : Timeline
        Virtual time and random streams.
    exits : dict of str to Exit
        Exit action of each component that has exited.
    """

    def __init__(
        self,
        components: Iterable[Component],
        seed: int = 0,
        *,
        compute: Mapping[str, Compute] | None = None,
        faults: Sequence[Fault] = (),
        taps: Sequence[Tap] = (),
    ) -> None:
        self.timeline = Timeline(seed)
        self.exits: dict[str, Exit] = {}
        self._compute, self._taps = compute or {}, taps
        self._transport = Transport(self.timeline, faults)
        self._serial = itertools.count(1)
        self._calls: dict[int, tuple[Process, str]] = {}
        self._processes: dict[str, Process] = {}
        self._wires: dict[str, list[tuple[Process, Port]]] = {}
        self._lost_ports: dict[tuple[str, str], str] = {}
        for component in components:
            self.start(component)

    @property
    def now(self) -> float:
        """Virtual time since the start [s]."""
        return self.timeline.now

    def run(self, seconds: float) -> bool:
        """Run until a component exits, or for `seconds`; return whether one exited."""
        return self.timeline.run(seconds)

    # ---- life of components and faults ----------------------------------------------------------

    def start(self, component: Component) -> None:
        """Start a component, or restart one that was killed or has exited.

        Raises
        ------
        ValueError
            If a component of this name is running.
        """
        name = component.name
        if name in self._processes:
            raise ValueError(f"component {name!r} is already running")
        self.exits.pop(name, None)
        compute = self._compute.get(name, uniform(*COMPUTE))
        process = Process(component, compute, self.timeline, self._execute)
        for number, timer in enumerate(component.timers):
            phase = self.timeline.draw(f"{name}/timer {number}/phase", (0.0, timer.period))
            self.timeline.call_after(phase, self._ticking(process, f"timer {number}", timer))
        self.timeline.call_after(_DIAGNOSTICS_PERIOD, partial(self._report_health, process))
        for other in self._processes.values():
            for pair in ((process, other), (other, process)):
                found = self.timeline.draw(f"discovery/{pair[0].name}/{pair[1].name}", DISCOVERY)
                self.timeline.call_after(found, partial(self._discover, *pair))
        self._processes[name] = process
        for row in component.ports:
            self._wires.setdefault(row.name, []).append((process, row))
        for owner, port in self._lost_ports:
            if owner == name:
                self._report_port(name, port)

    def kill(self, name: str) -> None:
        """End a component at once, like SIGKILL; the others drop it after `LEASE`."""
        process = self._named(name)
        self._remove(process)
        self.timeline.call_after(LEASE, partial(self._forget, process))

    def stop(self, name: str) -> None:
        """Request the shutdown of a component."""
        process = self._named(name)
        process.enqueue("stop", process.component.on_stop)

    def freeze(self, name: str, seconds: float) -> None:
        """Freeze a component for some time, like SIGSTOP."""
        self._named(name).freeze(seconds)

    def slow_down(self, name: str, seconds: float, extra: float) -> None:
        """Increase the compute time of a component's handlers by `extra` for some time [s]."""
        process = self._named(name)
        process.slowness = extra
        self.timeline.call_after(seconds, partial(setattr, process, "slowness", 0.0))

    def lose_port(self, name: str, port: str, why: str) -> None:
        """Interrupt a component's port, and report the reason to the component."""
        self._lost_ports[name, port] = why
        self._report_port(name, port)

    def open_port(self, name: str, port: str) -> None:
        """Reopen an interrupted port, and report this to its component."""
        if self._lost_ports.pop((name, port), None) is not None:
            self._report_port(name, port)

    def _report_port(self, name: str, port: str) -> None:
        change = PortChange(self._lost_ports.get((name, port), ""))
        for row in self._processes[name].component.ports if self.runs(name) else ():
            if row.name == port:
                self._processes[name].enqueue(port, partial(row.on_change, change))

    def configure(self, name: str, settings: Any) -> None:
        """Change a component's settings."""
        process = self._named(name)
        process.enqueue("settings", partial(process.component.on_settings, settings))

    def runs(self, name: str) -> bool:
        """Return whether a component runs, even if it is frozen."""
        return name in self._processes

    def is_responsive(self, name: str) -> bool:
        """Return whether a component runs and is not frozen."""
        return self.runs(name) and not self._processes[name].is_frozen

    def _named(self, name: str) -> Process:
        if name not in self._processes:
            raise ValueError(f"no component {name!r}: {', '.join(self._processes)}")
        return self._processes[name]

    def _remove(self, process: Process) -> None:
        process.end()
        del self._processes[process.name]
        for row in process.component.ports:
            self._wires[row.name].remove((process, row))

    # ---- actions --------------------------------------------------------------------------------

    def _execute(self, process: Process, action: Action) -> None:
        match action:
            case Publish(topic, message):
                self._publish(process, process.outputs[topic], message)
            case Send(port, batch):
                self._send_through(process, port, batch)
            case Call():
                self._call(process, action)
            case Reply():
                self._reply(process, action)
            case Log(severity, text):
                line = LogLine(self.timeline.stamp_ns, severity, process.name, text)
                self._publish(process, LOG, line)
            case Diagnose(part, diagnostic):
                self._diagnose(process, part, diagnostic)
            case Exit():
                self.exits[process.name] = action
                self.timeline.interrupt()
                self._remove(process)
                self._forget(process)

    def _ticking(self, process: Process, source: str, timer: Timer) -> Callable[[], None]:
        def tick() -> None:
            if process.is_alive:
                # A timer that missed several periods fires once.
                process.enqueue(source, timer.handler, depth=1)
                self.timeline.call_after(timer.period, tick)

        return tick

    # ---- topics and ports -----------------------------------------------------------------------

    def _publish(self, process: Process, output: Output, message: Any) -> None:
        for tap in self._taps:
            tap(self.timeline.stamp_ns, process.name, message, output)
        topic = output.topic
        if output.delivery.latched:
            process.latched[topic] = message
        routes = process.routes.get(topic)
        if routes is None:
            # As in ROS, a component receives its own messages.
            receivers = (process, *process.known)
            routes = process.routes[topic] = [
                route for other in receivers for route in _routes(process, topic, other)
            ]
        for route in routes:
            self._send(route, message)

    def _send(self, route: tuple[Process, Input, Link], message: Any) -> None:
        receiver, row, link = route
        arrive = partial(self._deliver, receiver, row, self.timeline.stamp_ns)
        self._transport.send(link, message, LATENCY, arrive)

    def _deliver(self, receiver: Process, row: Input, sent_ns: int, message: Any) -> None:
        depth = row.delivery.depth
        receiver.enqueue(row.topic, partial(row.handler, message), depth=depth, sent_ns=sent_ns)

    def _send_through(self, sender: Process, port: str, batch: tuple[Any, ...]) -> None:
        lost = self._lost_ports
        if (sender.name, port) in lost:
            return
        for receiver, row in self._wires.get(port, ()):
            if receiver is not sender and (receiver.name, port) not in lost:
                link = Link(sender.name, port, receiver.name)
                arrive = partial(self._arrive, receiver, row)
                self._transport.send(link, batch, PORT_LATENCY, arrive)

    def _arrive(self, receiver: Process, row: Port, batch: tuple[Any, ...]) -> None:
        waiting = receiver.batches.setdefault(row.name, [])
        waiting += batch
        if len(waiting) == len(batch):
            # Batches that arrive before the handler runs are handled together.
            receiver.enqueue(row.name, lambda at: row.handler(receiver.batches.pop(row.name), at))

    # ---- discovery ------------------------------------------------------------------------------

    def _discover(self, process: Process, other: Process) -> None:
        """Connect one component to another, which receives its messages from now on."""
        if not (process.is_alive and other.is_alive):
            return
        process.known.append(other)
        for topic, message in process.latched.items():
            for route in _routes(process, topic, other):
                self._send(route, message)
        self._report_peers(process)

    def _forget(self, gone: Process) -> None:
        """Remove an ended component from the peers of all others."""
        for process in self._processes.values():
            if gone in process.known:
                process.known.remove(gone)
                self._report_peers(process)

    def _report_peers(self, process: Process) -> None:
        process.routes.clear()
        peers = Peers.of(p.component for p in (process, *process.known))
        process.enqueue("peers", partial(process.component.on_peers, peers))

    # ---- diagnostics ----------------------------------------------------------------------------

    def _diagnose(self, process: Process, part: str, diagnostic: Diagnostic) -> None:
        before = process.health.get(part)
        process.health[part] = diagnostic
        now = diagnostic.level, diagnostic.message
        if before is None or (before.level, before.message) != now:
            self._publish_health(process, (part,))

    def _report_health(self, process: Process) -> None:
        if process.is_alive:
            if process.health:
                self._publish_health(process, tuple(process.health))
            self.timeline.call_after(_DIAGNOSTICS_PERIOD, partial(self._report_health, process))

    def _publish_health(self, process: Process, parts: Sequence[str]) -> None:
        statuses = tuple(Status.of(process.name, part, process.health[part]) for part in parts)
        self._publish(process, DIAGNOSTICS, Diagnostics(self.timeline.stamp_ns, statuses))

    # ---- services -------------------------------------------------------------------------------

    def _call(self, caller: Process, call: Call) -> None:
        number = next(self._serial)
        self._calls[number] = (caller, call.service)
        servers = [
            (process, service)
            for process in caller.known
            for service in process.component.services
            if service.name == call.service
        ]
        for process, service in servers:
            link = Link(caller.name, call.service, process.name)
            arrive = partial(self._request, process, service, number)
            self._transport.send(link, call.request, LATENCY, arrive)
        if servers:
            none = Answer(call.service, False, "no answer", answered=False)
            self.timeline.call_after(ANSWER_TIMEOUT, partial(self._answer, number, none))
        else:
            self._answer(number, Answer(call.service, False, "no server", answered=False))

    def _request(
        self, process: Process, service: Service, number: int, argument: bool | None
    ) -> None:
        process.enqueue(service.name, partial(service.handler, argument, number))

    def _reply(self, process: Process, reply: Reply) -> None:
        if reply.request in self._calls:
            caller, service = self._calls[reply.request]
            answer = Answer(service, reply.success, reply.text)
            link = Link(process.name, service, caller.name)
            self._transport.send(link, answer, LATENCY, partial(self._answer, reply.request))

    def _answer(self, number: int, answer: Answer) -> None:
        """Deliver the outcome of a call to its caller; only the first one counts."""
        if number in self._calls:
            caller, _ = self._calls.pop(number)
            caller.enqueue("answer", partial(caller.component.on_answer, answer))


def _routes(sender: Process, topic: str, receiver: Process) -> list[tuple[Process, Input, Link]]:
    """Return the routes of a topic from one component to another."""
    link = Link(sender.name, topic, receiver.name)
    rows = receiver.component.inputs
    return [(receiver, row, link) for row in rows if row.topic == topic]
