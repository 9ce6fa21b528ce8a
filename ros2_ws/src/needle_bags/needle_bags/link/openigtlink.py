"""openigtlink as a component: the steered needle for 3D Slicer and the like."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from needle_bags.link.link_messages import packed
from needle_bags.live.live_needle import LiveNeedle
from needle_bags.live.needle_inputs import needle_inputs
from needle_core.component import Actions, Component, Diagnose, Log, Moment, Port, Send, Timer
from needle_core.diagnostics import Diagnostic, Level
from needle_core.settings.parameter_fields import check_fields, fixed_parameter

LINK = "link"
"""Name of the port."""


@dataclasses.dataclass(frozen=True)
class OpenIGTLinkParameters:
    """Parameters of openigtlink."""

    address: str = fixed_parameter(
        "127.0.0.1", "-", "Where it listens; beyond loopback all of that network can look on."
    )
    port: int = fixed_parameter(18944, "-", "Port that Slicer connects to; 0: any.", 0, 65535)
    rate: float = fixed_parameter(10.0, "Hz", "How often all is sent.", 0.5, 30.0)

    def __post_init__(self) -> None:
        """Check the fields; raises UserError as `check_fields`."""
        check_fields(self)


@dataclasses.dataclass(frozen=True)
class Listeners:
    """Number of those who listen at the port, and of those that it has turned away so far."""

    count: int
    turned_away: int


class OpenIGTLink(Component):
    """Says a `LiveNeedle` at a port.

    Parameters
    ----------
    settings : OpenIGTLinkParameters
        The node's parameters.
    """

    name = "openigtlink"
    takes_simulated_time = True

    def __init__(self, settings: OpenIGTLinkParameters) -> None:
        self.settings = settings
        self._needle = LiveNeedle()
        self._listeners = 0
        self.inputs = needle_inputs(self._needle)
        self.ports = (Port(LINK, self._on_link),)
        self.timers = (Timer(1.0 / settings.rate, self._say),)

    def _on_link(self, events: Sequence[Log | Listeners], at: Moment) -> Actions:
        for event in events:
            match event:
                case Log():
                    yield event
                case Listeners(count, turned_away):
                    self._listeners = count
                    keys = {"listeners": str(count), "turned away": str(turned_away)}
                    line = f"{count} listening" if count else "nobody listens"
                    yield Diagnose("listeners", Diagnostic(Level.OK, line, keys))

    def _say(self, at: Moment) -> Actions:
        # Also where there is nothing to say: the port has its turn by this.
        yield Send(LINK, (packed(self._needle, at.stamp_ns * 1e-9) if self._listeners else b"",))
