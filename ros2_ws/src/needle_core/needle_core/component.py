"""Component model: the behaviour of a node, independent of the runner that executes it.

A component declares its inputs, outputs, services and timers as rows. A handler receives an event
and its moment, and returns actions. It reads no clock, starts no thread, opens no socket and never
blocks: a runner delivers messages and time, and executes the actions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from needle_core.diagnostics import Diagnostic


@dataclass(frozen=True)
class Moment:
    """Clock readings that are passed to a handler.

    Attributes
    ----------
    steady : float
        Monotonic time, for ages and time-outs [s].
    stamp_ns : int
        Time for message headers [ns].
    sent_ns : int
        Send time of the handled message, on its sender's clock [ns]; 0 for other events.
    """

    steady: float
    stamp_ns: int
    sent_ns: int = 0


@dataclass(frozen=True)
class Delivery:
    """Quality of service of a topic: the QoS profile in ROS.

    Attributes
    ----------
    depth : int
        Length of the receiver's queue; a full queue drops its oldest message.
    reliable : bool
        Whether delivery is guaranteed.
    latched : bool
        Whether a late subscriber receives the last message.
    """

    depth: int = 10
    reliable: bool = True
    latched: bool = False


RELIABLE = Delivery()
LATCHED = Delivery(depth=1, latched=True)
BEST_EFFORT = Delivery(depth=1, reliable=False)
JOINT_STATES = Delivery(depth=200)
"""Queue for 4 s at 50 Hz, so that a suspended receiver loses no message."""
IMAGES = Delivery(depth=5)
IMAGES_BEST_EFFORT = Delivery(depth=2, reliable=False)


# ---- Actions that a handler returns ----------------------------------------------------------


@dataclass(frozen=True)
class Publish:
    """Publish a message on one of the component's outputs."""

    topic: str
    message: Any


@dataclass(frozen=True)
class Call:
    """Call a service; the answer arrives at `Component.on_answer`.

    `request` is the request of a std_srvs/SetBool, None for a std_srvs/Trigger.
    """

    service: str
    request: bool | None = None


@dataclass(frozen=True)
class Reply:
    """Answer the service request with this number, in its handler or in a later one."""

    request: int
    success: bool
    text: str = ""


@dataclass(frozen=True)
class Send:
    """Send an ordered batch through one of the component's ports."""

    port: str
    batch: tuple[Any, ...]


@dataclass(frozen=True)
class Log:
    """Log a line; `severity` is info, warning or error; lines of one `kind` are throttled."""

    severity: str
    text: str
    kind: str = ""


@dataclass(frozen=True)
class Listen:
    """Subscribe to a lazy input, or unsubscribe from it."""

    topic: str
    on: bool


@dataclass(frozen=True)
class Diagnose:
    """Report the diagnostic of one part of the component."""

    part: str
    diagnostic: Diagnostic


@dataclass(frozen=True)
class Exit:
    """End the component's process with an exit code and one line for the user."""

    code: int
    text: str = ""


Action = Publish | Send | Call | Reply | Log | Listen | Diagnose | Exit
Actions = Iterable[Action]


# ---- Rows that a component declares ----------------------------------------------------------


@dataclass(frozen=True)
class Input:
    """Topic that the component receives; messages longer than `max_bytes` are rejected.

    A lazy input is subscribed by a `Listen` action only.
    """

    topic: str
    message: type[Any]
    handler: Callable[[Any, Moment], Actions]
    delivery: Delivery = RELIABLE
    max_bytes: int = 1 << 26
    lazy: bool = False


@dataclass(frozen=True)
class Output:
    """Topic that the component publishes; `exclusive` permits only one publisher per machine."""

    topic: str
    message: type[Any]
    delivery: Delivery = RELIABLE
    exclusive: bool = False


@dataclass(frozen=True)
class PortChange:
    """Loss or recovery of a port; the runner reopens ports by itself.

    Attributes
    ----------
    lost : str
        Reason of the loss: missing, unplugged, send buffer full; empty if the port is open.
    """

    lost: str = ""


def _ignore(change: PortChange, at: Moment) -> Actions:
    return ()


@dataclass(frozen=True)
class Port:
    """Connection other than topics, such as a CAN bus; the handler receives whole batches.

    Ports of the same name are connected: a batch sent by one arrives at the others, in order.
    A port counts as open until `on_change` reports its loss.
    """

    name: str
    handler: Callable[[Sequence[Any], Moment], Actions]
    on_change: Callable[[PortChange, Moment], Actions] = _ignore


Batch = tuple[Any, ...] | Callable[[], tuple[Any, ...]]
"""Input of a port, or a function that returns it at handling time, so that it is not outdated."""


class RealPort(Protocol):
    """Real implementation of a component's port; it may have a reader thread."""

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Open the port; `arrive` accepts input from any thread."""

    def send(self, batch: tuple[Any, ...]) -> None:
        """Send a batch; never block."""

    def close(self) -> None:
        """Close the port after all pending batches have been sent."""


@dataclass(frozen=True)
class Service:
    """Service that the component offers: a SetBool if `has_argument`, else a Trigger.

    The handler receives the request's Boolean (None for a Trigger), its number and the moment.
    """

    name: str
    handler: Callable[[bool | None, int, Moment], Actions]
    has_argument: bool = False


@dataclass(frozen=True)
class Timer:
    """Handler that runs every `period` seconds."""

    period: float
    handler: Callable[[Moment], Actions]


ANSWER_TIMEOUT = 5.0
"""Time after which a call without an answer counts as failed [s]."""


@dataclass(frozen=True)
class Answer:
    """Outcome of a service call.

    Attributes
    ----------
    service : str
        Name of the service.
    success : bool
        Whether the server succeeded.
    text : str
        Message of the server, or the reason why there is none.
    answered : bool
        False if no server existed, or it did not answer in time.
    """

    service: str
    success: bool
    text: str
    answered: bool = True


@dataclass(frozen=True)
class Peers:
    """Other components on the graph, as one component has discovered them.

    Attributes
    ----------
    publishers : mapping of str to tuple of str
        Topic to the names of the nodes that publish it.
    subscribers : mapping of str to tuple of str
        Topic to the names of the nodes that subscribe to it.
    services : frozenset of str
        Services with a server.
    nodes : frozenset of str
        Full names of all nodes.
    """

    publishers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    subscribers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    services: frozenset[str] = frozenset()
    nodes: frozenset[str] = frozenset()

    @staticmethod
    def of(components: Iterable[Component]) -> Peers:
        """Return the graph that consists of these components."""
        publishers: dict[str, tuple[str, ...]] = {}
        subscribers: dict[str, tuple[str, ...]] = {}
        services: list[str] = []
        nodes: list[str] = []
        for component in components:
            nodes.append(component.name)
            services += [service.name for service in component.services]
            for output in component.outputs:
                names = publishers.get(output.topic, ())
                publishers[output.topic] = (*names, component.name)
            for row in component.inputs:
                names = subscribers.get(row.topic, ())
                subscribers[row.topic] = (*names, component.name)
        return Peers(publishers, subscribers, frozenset(services), frozenset(nodes))


class Component:
    """Base of every component: a name, settings and rows.

    Attributes
    ----------
    name : str
        Name of the node.
    settings : object
        Settings dataclass with the node's parameters; None if it has none.
    accepts_simulated_time : bool
        Whether its stamps may come from a player's clock; only for viewers, which cause no motion.
    inputs, outputs, services, timers, ports : sequences of rows
        Declarations of the component; empty by default.
    """

    name: str
    settings: Any = None
    accepts_simulated_time: bool = False
    inputs: Sequence[Input] = ()
    outputs: Sequence[Output] = ()
    services: Sequence[Service] = ()
    timers: Sequence[Timer] = ()
    ports: Sequence[Port] = ()

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Handle the outcome of a service call."""
        return ()

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Handle a change of the discovered peers."""
        return ()

    def on_settings(self, settings: Any, at: Moment) -> Actions:
        """Apply changed settings."""
        return ()

    def on_stop(self, at: Moment) -> Actions:
        """Handle a shutdown request: stop all motion and exit."""
        return (Exit(0),)
