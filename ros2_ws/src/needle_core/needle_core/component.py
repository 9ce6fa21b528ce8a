"""The component model: what a node is, without saying how it runs.

A component declares its inputs, outputs, services and timers as rows. A handler gets an event and
the moment, and returns actions. It reads no clock, starts no thread, opens no socket and waits for
nothing: a runner delivers messages and time, and carries out the actions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from needle_core.diagnostics import Diagnostic


@dataclass(frozen=True)
class Moment:
    """Times at which a handler runs.

    Attributes
    ----------
    steady : float
        Monotonic time, for ages and time-outs [s].
    stamp_ns : int
        Time for message headers [ns].
    sent_ns : int
        When the message that is handled was sent, on its sender's clock [ns]; 0 for other events.
    """

    steady: float
    stamp_ns: int
    sent_ns: int = 0


@dataclass(frozen=True)
class Delivery:
    """Delivery of a topic; in ROS: the QoS profile.

    Attributes
    ----------
    depth : int
        Messages that wait while the receiver is busy; where there is no room the oldest goes.
    reliable : bool
        Whether a message that is sent arrives.
    latched : bool
        Whether a receiver that comes late gets the last message.
    """

    depth: int = 10
    reliable: bool = True
    latched: bool = False


RELIABLE = Delivery()
LATCHED = Delivery(depth=1, latched=True)
BEST_EFFORT = Delivery(depth=1, reliable=False)
JOINT_STATES = Delivery(depth=200)
"""Four seconds of them, at 50 a second, for a receiver that stands still meanwhile."""
IMAGES = Delivery(depth=5)
IMAGES_BEST_EFFORT = Delivery(depth=2, reliable=False)


# ---- Actions: all that a handler can bring about ---------------------------------------------


@dataclass(frozen=True)
class Publish:
    """Send a message on one of the component's outputs."""

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
    """Answer the service request of this number, now or in a later handler."""

    request: int
    success: bool
    text: str = ""


@dataclass(frozen=True)
class Send:
    """Send a batch, in its order, through one of the component's ports."""

    port: str
    batch: tuple[Any, ...]


@dataclass(frozen=True)
class Log:
    """Log a line; `severity` is info, warning or error, `kind` throttles repetitions."""

    severity: str
    text: str
    kind: str = ""


@dataclass(frozen=True)
class Listen:
    """Receive a lazy input from now on, or no longer."""

    topic: str
    on: bool


@dataclass(frozen=True)
class Diagnose:
    """Report the health of one part of the component."""

    part: str
    diagnostic: Diagnostic


@dataclass(frozen=True)
class Exit:
    """End the component's process with an exit code and one line for a person."""

    code: int
    text: str = ""


Action = Publish | Send | Call | Reply | Log | Listen | Diagnose | Exit
Actions = Iterable[Action]


# ---- Rows: all that a component is asked to handle -------------------------------------------


@dataclass(frozen=True)
class Input:
    """A topic that the component receives; what has more than `longest` bytes is refused.

    A lazy one need not be received before the component listens.
    """

    topic: str
    message: type[Any]
    handler: Callable[[Any, Moment], Actions]
    delivery: Delivery = RELIABLE
    longest: int = 1 << 26
    lazy: bool = False


@dataclass(frozen=True)
class Output:
    """A topic that the component sends; `alone`: that one process of a machine may send."""

    topic: str
    message: type[Any]
    delivery: Delivery = RELIABLE
    alone: bool = False


@dataclass(frozen=True)
class PortChange:
    """A port is lost, or open again: its runner opens it by itself.

    Attributes
    ----------
    lost : str
        Why nothing passes: not there, unplugged, its send buffer is full; empty: it is open.
    """

    lost: str = ""


def _ignore(change: PortChange, at: Moment) -> Actions:
    return ()


@dataclass(frozen=True)
class Port:
    """An edge to the world other than topics, such as a CAN bus; the handler gets whole batches.

    Ports of one name are wired together: what goes out of one arrives at the others, in order.
    A port is open until `on_change` hears that it is not.
    """

    name: str
    handler: Callable[[Sequence[Any], Moment], Actions]
    on_change: Callable[[PortChange, Moment], Actions] = _ignore


Batch = tuple[Any, ...] | Callable[[], tuple[Any, ...]]
"""What comes in at a port, or what returns it when it is handled: it may have aged until then."""


class RealPort(Protocol):
    """The real implementation of a component's port; it may have a reader thread."""

    def open(self, arrive: Callable[[Batch | PortChange], None]) -> None:
        """Begin; `arrive` takes what has come in, from any thread."""

    def send(self, batch: tuple[Any, ...]) -> None:
        """Send a batch; never waits."""

    def close(self) -> None:
        """End, after what was sent is out."""


@dataclass(frozen=True)
class Service:
    """A service that the component offers: a SetBool if `has_argument`, else a Trigger.

    The handler gets the request's Boolean (None of a Trigger), the request's number and the moment.
    """

    name: str
    handler: Callable[[bool | None, int, Moment], Actions]
    has_argument: bool = False


@dataclass(frozen=True)
class Timer:
    """A handler that runs every `period` seconds."""

    period: float
    handler: Callable[[Moment], Actions]


ANSWER_TIMEOUT = 5.0
"""A call without an answer is given up after this time [s]."""


@dataclass(frozen=True)
class Answer:
    """Outcome of a service call.

    Attributes
    ----------
    service : str
        Name of the service.
    success : bool
        Whether the server did what was asked.
    text : str
        The server's message, or why there is none.
    answered : bool
        False if there was no server, or it did not answer in time.
    """

    service: str
    success: bool
    text: str
    answered: bool = True


@dataclass(frozen=True)
class Peers:
    """Knowledge that a component has of the others.

    Attributes
    ----------
    publishers : mapping of str to tuple of str
        Topic to the names of the nodes that publish it.
    subscribers : mapping of str to tuple of str
        Topic to the names of the nodes that receive it.
    services : frozenset of str
        Services that somebody offers.
    nodes : frozenset of str
        Full names of all nodes.
    """

    publishers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    subscribers: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    services: frozenset[str] = frozenset()
    nodes: frozenset[str] = frozenset()

    @staticmethod
    def of(components: Iterable[Component]) -> Peers:
        """Return what is known to one that knows these, its own rows included."""
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
        The node's name.
    settings : object
        Its settings dataclass, the parameters of the node; None without any.
    accepts_simulated_time : bool
        Whether its stamps may come from a player's clock: of viewers, which move nothing.
    inputs, outputs, services, timers, ports : sequences of rows
        What it receives, sends, offers, does by itself and is wired to; none by default.
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
        """Handle the outcome of a call."""
        return ()

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Handle a change of what is known of other components."""
        return ()

    def on_settings(self, settings: Any, at: Moment) -> Actions:
        """Take changed settings."""
        return ()

    def on_stop(self, at: Moment) -> Actions:
        """Handle the wish to end: bring everything to rest and exit."""
        return (Exit(0),)
