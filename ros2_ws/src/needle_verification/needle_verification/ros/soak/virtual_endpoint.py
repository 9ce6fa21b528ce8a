"""A node's end of a topic or service of a virtual graph, and what passes between two of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

from needle_verification.soak.judging.invariants import DISCOVERED_WITHIN
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualProcess

# From an endpoint's creation until another process knows it [ns], at least and at most.
_DISCOVERY_NS = (5_000_000, round(DISCOVERED_WITHIN * NANOSECONDS))
# Nobody here asks which version of a type it is.
_ANY_HASH = "RIHS01_" + "0" * 64


class Sample(NamedTuple):
    """A message on its way.

    Attributes
    ----------
    data : bytes
        As CDR.
    sent_ns : int
        When, system clock [ns].
    number : int
        Of its publisher's messages, from 1.
    """

    data: bytes
    sent_ns: int
    number: int


class Endpoint:
    """A node's publisher, subscription, service or client, as others find it.

    Parameters
    ----------
    process : VirtualProcess
        Whose it is.
    node_name : str
        Its node's full name.
    name : str
        Topic or service.
    qos : QoSProfile, optional
        As created; a service has none.
    """

    msg_type: type[Any]

    def __init__(
        self,
        process: VirtualProcess,
        node_name: str,
        name: str,
        qos: Any = None,
    ) -> None:
        self.process = process
        self.node_name = node_name
        self.topic_name = self.topic = self.srv_name = name
        self.qos_profile = qos
        self.created_ns = process.world.steady_ns
        self.gone_ns: int | None = None
        self._known_ns: dict[VirtualProcess, int] = {process: self.created_ns}

    def known_ns(self, process: VirtualProcess) -> int:
        """Return when a process comes to know it, steady clock [ns]."""
        if process not in self._known_ns:
            found = "discovery", self.node_name, self.topic_name, process.name
            late_ns = self.process.world.chance(*found).randint(*_DISCOVERY_NS)
            self._known_ns[process] = max(self.created_ns, process.started_ns) + late_ns
        return self._known_ns[process]

    def is_seen(self, process: VirtualProcess) -> bool:
        """Return whether a process takes it for there."""
        now = self.process.world.steady_ns
        return (self.gone_ns is None or now < self.gone_ns) and self.known_ns(process) <= now

    @property
    def type_name(self) -> str:
        """Name of a topic's type."""
        return f"{self.msg_type.__module__.partition('.')[0]}/msg/{self.msg_type.__name__}"

    @property
    def info(self) -> SimpleNamespace:
        """Answer of rclpy's `get_*_info_by_topic` about it."""
        namespace, _, name = self.node_name.rpartition("/")
        return SimpleNamespace(
            node_name=name,
            node_namespace=namespace or "/",
            qos_profile=self.qos_profile,
            topic_type_hash=_ANY_HASH,
        )
