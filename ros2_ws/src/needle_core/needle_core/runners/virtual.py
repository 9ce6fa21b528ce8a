"""Run components in one process on a virtual clock: the same seed gives the same run, bit for bit.

An event heap holds deliveries, timers and answers. Each delivery takes a latency, each handler a
compute time, both drawn from the seed: every link and every handler has a random stream of its own,
so that adding a component changes no other draw. While a component computes, its inputs wait
in a queue, as deep as their delivery says.
"""

from __future__ import annotations

import heapq
import itertools
import random
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from needle_core.component import (
    RELIABLE,
    Action,
    Actions,
    Answer,
    Call,
    Component,
    Delivery,
    Diagnose,
    Exit,
    Input,
    Log,
    Moment,
    Output,
    Peers,
    Port,
    Publish,
    Reply,
    Send,
    Service,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import Diagnostics, LogLine, Status
from needle_core.runners.faults import Fault, Link

START_NS = 1_000_000_000
"""Stamp at the begin of a run [ns]; ROS takes 0 for no time yet."""
DIAGNOSTICS = Output("/diagnostics", Diagnostics)
LOG = Output("/rosout", LogLine)
LATENCY = (0.3e-3, 1.5e-3)
"""Delay of a delivery, as between processes on one computer [s]."""
PORT_LATENCY = (0.15e-3, 0.6e-3)
"""Delay of a batch between ports, adapter included [s]."""
COMPUTE = (0.1e-3, 0.3e-3)
"""Compute time of a handler where none is given [s]."""
DISCOVERY = (0.02, 0.2)
"""Time until one component knows another [s]."""
ANSWER_TIMEOUT = 5.0
"""A call without an answer is given up after this time [s]."""
_DIAGNOSTICS_PERIOD = 1.0
_NEWEST = Delivery(depth=1, reliable=False)

Compute = Callable[[Sequence[Action], random.Random], float]
"""Compute time of a handler [s], from its actions and a random stream."""
Tap = Callable[[int, str, Any, Output], None]
"""Told of each publication before any fault: stamp [ns], sender, message, output."""


def uniform(shortest: float, longest: float) -> Compute:
    """Return a compute time that is the same for all handlers, between two bounds [s]."""
    return lambda actions, rng: rng.uniform(shortest, longest)


@dataclass(eq=False)
class _Process:
    """A component with its queue: handlers run one after the other, each for its compute time."""

    component: Component
    compute: Compute
    outputs: Mapping[str, Output]
    busy: bool = False
    frozen_until: float = 0.0
    exit: Exit | None = None
    queue: deque[tuple[str, Callable[[], Actions]]] = field(default_factory=deque)
    known: list[_Process] = field(default_factory=list)
    latched: dict[str, Any] = field(default_factory=dict)
    health: dict[str, Diagnostic] = field(default_factory=dict)
    failures: int = 0

    @property
    def name(self) -> str:
        return self.component.name


class VirtualRunner:
    """Event heap over components.

    Parameters
    ----------
    components : iterable of Component
        Each is a process of its own.
    seed : int
        Keys every latency and compute time.
    compute : mapping of str to Compute
        Component to the compute times of its handlers; `COMPUTE` where not given.
    faults : sequence of Fault
        Applied to each delivery, in order.
    taps : sequence of Tap
        Told of every publication.
    real_time_factor : float
        Virtual over real time; 0: as fast as possible.

    Attributes
    ----------
    now : float
        Virtual time since the begin [s].
    exits : dict of str to Exit
        Components that have ended.
    """

    def __init__(
        self,
        components: Iterable[Component],
        seed: int = 0,
        *,
        compute: Mapping[str, Compute] | None = None,
        faults: Sequence[Fault] = (),
        taps: Sequence[Tap] = (),
        real_time_factor: float = 0.0,
    ) -> None:
        self.now = 0.0
        self.exits: dict[str, Exit] = {}
        self._seed, self._faults, self._taps = seed, faults, taps
        self._real_time_factor = real_time_factor
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._serial = itertools.count(1)
        self._streams: dict[str, random.Random] = {}
        self._wired_until: dict[Link, float] = {}
        self._calls: dict[int, tuple[_Process, str]] = {}
        self._processes = [
            _Process(
                component,
                (compute or {}).get(component.name, uniform(*COMPUTE)),
                {output.topic: output for output in component.outputs},
            )
            for component in components
        ]
        for process in self._processes:
            for number, timer in enumerate(process.component.timers):
                source = f"timer {number}"
                phase = self._draw(f"{process.name}/{source}/phase", (0.0, timer.period))
                self._at(phase, partial(self._tick, process, source, timer))
            self._at(_DIAGNOSTICS_PERIOD, partial(self._tell_health, process))
        for pair in itertools.permutations(self._processes, 2):
            found = self._draw(f"discovery/{pair[0].name}/{pair[1].name}", DISCOVERY)
            self._at(found, partial(self._discover, *pair))

    def run(self, seconds: float) -> bool:
        """Run until another component exits, or for `seconds`; return whether one did."""
        end, exits = self.now + seconds, len(self.exits)
        wall, begin = time.monotonic(), self.now
        while self._heap and self._heap[0][0] <= end:
            due = self._heap[0][0]
            if self._real_time_factor > 0.0:
                ahead = (due - begin) / self._real_time_factor - (time.monotonic() - wall)
                if ahead > 0.0:
                    time.sleep(ahead)
            self.now, _, event = heapq.heappop(self._heap)
            event()
            if len(self.exits) > exits:
                return True
        self.now = end
        return False

    def stop(self, name: str) -> None:
        """Ask a component to end."""
        process = self._named(name)
        self._offer(process, "stop", RELIABLE, lambda: process.component.on_stop(self._moment()))

    def freeze(self, name: str, seconds: float) -> None:
        """Let a component stand still from now on, as a stopped process does."""
        process = self._named(name)
        process.frozen_until = max(process.frozen_until, self.now + seconds)
        self._at(process.frozen_until, partial(self._work_off, process))

    # ---- time -----------------------------------------------------------------------------------

    def _stream(self, name: str) -> random.Random:
        stream = self._streams.get(name)
        if stream is None:
            stream = self._streams[name] = random.Random(f"{self._seed}/{name}")
        return stream

    def _draw(self, name: str, bounds: tuple[float, float]) -> float:
        return self._stream(name).uniform(*bounds)

    def _named(self, name: str) -> _Process:
        for process in self._processes:
            if process.name == name:
                return process
        raise ValueError(f"no component {name!r}: {', '.join(p.name for p in self._processes)}")

    def _at(self, when: float, event: Callable[[], None]) -> None:
        heapq.heappush(self._heap, (when, next(self._serial), event))

    def _moment(self, sent_ns: int = 0) -> Moment:
        return Moment(self.now, START_NS + round(self.now * 1e9), sent_ns)

    def _tick(self, process: _Process, source: str, timer: Timer) -> None:
        if process.exit is None:
            # A timer that was missed fires once, not once for each period.
            self._offer(process, source, _NEWEST, lambda: timer.handler(self._moment()))
            self._at(self.now + timer.period, partial(self._tick, process, source, timer))

    # ---- components -----------------------------------------------------------------------------

    def _offer(
        self, process: _Process, source: str, delivery: Delivery, work: Callable[[], Actions]
    ) -> None:
        """Queue an event; of an unreliable source only the newest `depth` wait."""
        if process.exit is not None:
            return
        if not delivery.reliable:
            waiting = [item for item in process.queue if item[0] == source]
            if len(waiting) >= delivery.depth:
                process.queue.remove(waiting[0])
        process.queue.append((source, work))
        self._work_off(process)

    def _work_off(self, process: _Process) -> None:
        if process.busy or not process.queue or self.now < process.frozen_until:
            return
        process.busy = True
        source, work = process.queue.popleft()
        actions = self._handle(process, work)
        busy = process.compute(actions, self._stream(f"{process.name}/{source}"))
        self._at(self.now + busy, partial(self._finish, process, actions))

    def _handle(self, process: _Process, work: Callable[[], Actions]) -> list[Action]:
        """Return the actions of a handler; one that raises is reported and ends nothing."""
        actions: list[Action] = []
        try:
            for action in work():
                if isinstance(action, Publish) and action.topic not in process.outputs:
                    raise ValueError(f"{action.topic} is not among its outputs")
                actions.append(action)
        except Exception as error:  # noqa: BLE001
            process.failures += 1
            text = f"internal error: {type(error).__name__}: {error}"
            values = {"failures": str(process.failures)}
            actions.append(Log("error", text))
            actions.append(Diagnose("handlers", Diagnostic(Level.ERROR, text, values)))
        return actions

    def _finish(self, process: _Process, actions: Sequence[Action]) -> None:
        if self.now < process.frozen_until:
            self._at(process.frozen_until, partial(self._finish, process, actions))
            return
        process.busy = False
        for action in actions:
            if process.exit is None:
                self._do(process, action)
        self._work_off(process)

    def _do(self, process: _Process, action: Action) -> None:
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
                line = LogLine(self._moment().stamp_ns, severity, process.name, text)
                self._publish(process, LOG, line)
            case Diagnose(part, diagnostic):
                self._diagnose(process, part, diagnostic)
            case Exit():
                process.exit = self.exits[process.name] = action
                process.queue.clear()

    # ---- topics ---------------------------------------------------------------------------------

    def _publish(self, process: _Process, output: Output, message: Any) -> None:
        stamp_ns = self._moment().stamp_ns
        for tap in self._taps:
            tap(stamp_ns, process.name, message, output)
        if output.delivery.latched:
            process.latched[output.topic] = message
        for receiver in process.known:
            self._send(process, receiver, output.topic, message)

    def _send(self, sender: _Process, receiver: _Process, topic: str, message: Any) -> None:
        sent_ns = self._moment().stamp_ns
        for row in receiver.component.inputs:
            if row.topic != topic:
                continue
            link = Link(sender.name, topic, receiver.name)
            for late, arrived in self._arrivals(link, message, LATENCY):
                event = partial(self._deliver, receiver, row, arrived, sent_ns)
                self._at(self.now + late, event)

    def _arrivals(
        self, link: Link, message: Any, latency: tuple[float, float]
    ) -> list[tuple[float, Any]]:
        rng = self._stream(str(link))
        arrivals: list[tuple[float, Any]] = [(rng.uniform(*latency), message)]
        for fault in self._faults:
            arrivals = [
                (late + extra, changed)
                for late, sent in arrivals
                for extra, changed in fault(link, sent, self.now, rng)
            ]
        return arrivals

    def _deliver(self, receiver: _Process, row: Input, message: Any, sent_ns: int) -> None:
        work = lambda: row.handler(message, self._moment(sent_ns))  # noqa: E731
        self._offer(receiver, row.topic, row.delivery, work)

    def _send_through(self, sender: _Process, port: str, batch: tuple[Any, ...]) -> None:
        for receiver in self._processes:
            for row in receiver.component.ports if receiver is not sender else ():
                if row.name == port:
                    link = Link(sender.name, port, receiver.name)
                    for late, arrived in self._arrivals(link, batch, PORT_LATENCY):
                        # A wire keeps the order.
                        when = max(self.now + late, self._wired_until.get(link, 0.0))
                        self._wired_until[link] = when
                        self._at(when, partial(self._arrive, receiver, row, arrived))

    def _arrive(self, receiver: _Process, row: Port, batch: tuple[Any, ...]) -> None:
        self._offer(receiver, row.name, RELIABLE, lambda: row.handler(batch, self._moment()))

    def _discover(self, process: _Process, other: _Process) -> None:
        """Let one component know another: from now on its messages get there."""
        process.known.append(other)
        for topic, message in process.latched.items():
            self._send(process, other, topic, message)
        peers = Peers.of(p.component for p in (process, *process.known))
        self._offer(
            process, "peers", RELIABLE, lambda: process.component.on_peers(peers, self._moment())
        )

    # ---- health ---------------------------------------------------------------------------------

    def _diagnose(self, process: _Process, part: str, diagnostic: Diagnostic) -> None:
        before = process.health.get(part)
        process.health[part] = diagnostic
        now = diagnostic.level, diagnostic.message
        if before is None or (before.level, before.message) != now:
            self._publish_health(process, (part,))

    def _tell_health(self, process: _Process) -> None:
        if process.exit is None:
            if process.health:
                self._publish_health(process, tuple(process.health))
            self._at(self.now + _DIAGNOSTICS_PERIOD, partial(self._tell_health, process))

    def _publish_health(self, process: _Process, parts: Sequence[str]) -> None:
        statuses = tuple(Status.of(process.name, part, process.health[part]) for part in parts)
        self._publish(process, DIAGNOSTICS, Diagnostics(self._moment().stamp_ns, statuses))

    # ---- services -------------------------------------------------------------------------------

    def _call(self, caller: _Process, call: Call) -> None:
        number = next(self._serial)
        self._calls[number] = (caller, call.service)
        for process in caller.known:
            for service in process.component.services:
                if service.name == call.service and process.exit is None:
                    request = partial(self._request, process, service, call.request, number)
                    late = self._draw(f"{caller.name}/call", LATENCY)
                    self._at(self.now + late, request)
                    none = Answer(call.service, False, "no answer", answered=False)
                    self._at(self.now + ANSWER_TIMEOUT, partial(self._answer, number, none))
                    return
        self._answer(number, Answer(call.service, False, "no server", answered=False))

    def _request(
        self, process: _Process, service: Service, argument: bool | None, number: int
    ) -> None:
        work = lambda: service.handler(argument, number, self._moment())  # noqa: E731
        self._offer(process, service.name, RELIABLE, work)

    def _reply(self, process: _Process, reply: Reply) -> None:
        if reply.request in self._calls:
            service = self._calls[reply.request][1]
            answer = Answer(service, reply.success, reply.text)
            late = self._draw(f"{process.name}/reply", LATENCY)
            self._at(self.now + late, partial(self._answer, reply.request, answer))

    def _answer(self, number: int, answer: Answer) -> None:
        """Hand a call's outcome to its caller; only the first counts."""
        if number in self._calls:
            caller, _ = self._calls.pop(number)
            work = lambda: caller.component.on_answer(answer, self._moment())  # noqa: E731
            self._offer(caller, "answer", RELIABLE, work)
