"""Interface of device_driver to the drives behind one port."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any

from needle_core.diagnostics import Diagnostic
from needle_device_driver.axes.axis import Axis
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.procedure import Procedure


class Drives(abc.ABC):
    """The drives of one kind, with a common connection and cycle.

    Each cycle is `collect`, then orders to the axes, then `exchange`.

    Attributes
    ----------
    port : str
        Name of the component's port.
    name : str
        Name of the connection in messages.
    capabilities : Capabilities
        What the drives can do by themselves.
    axes : mapping of str to Axis
        Insertion, rotation or both.
    now : float
        Steady time of the running handler [s].
    """

    port: str
    name: str
    capabilities: Capabilities
    axes: Mapping[str, Axis]
    now: float

    @property
    def missing_optional_parts(self) -> tuple[str, ...]:
        """Parts that the drives lack, although a rule profits from them."""
        return ()

    @property
    @abc.abstractmethod
    def needs_cycles(self) -> bool:
        """Whether a drive still executes an order other than a set-point."""

    @abc.abstractmethod
    def receive(self, batch: Sequence[Any]) -> None:
        """Receive a batch from the port."""

    @abc.abstractmethod
    def set_port_error(self, error: str) -> None:
        """Note why the port is not open; empty: it is open."""

    @abc.abstractmethod
    def pop_outgoing(self) -> tuple[Any, ...]:
        """Return the batch that was sent since the last call."""

    @abc.abstractmethod
    def probe(self) -> Procedure[str]:
        """Open the link and request an answer of every drive; return the error."""

    @abc.abstractmethod
    def are_emulated(self) -> Procedure[bool]:
        """Return whether each drive reports that it is emulated; otherwise it counts as real.

        Raises
        ------
        LinkError
            If the link is lost.
        """

    @abc.abstractmethod
    def beat(self) -> None:
        """Report to the drives' watchdogs that the control loop runs, if the link is open."""

    @abc.abstractmethod
    def collect(self) -> None:
        """Process answers that arrived after the end of the last cycle."""

    @abc.abstractmethod
    def exchange(self, timeout: float) -> Procedure[None]:
        """Run one cycle; wait at most `timeout` [s] for the answers."""

    @abc.abstractmethod
    def health(self, waiting: str) -> Diagnostic:
        """Return the health of the link since the last call; `waiting` describes a closed link."""

    @abc.abstractmethod
    def close(self) -> None:
        """Close the link."""
