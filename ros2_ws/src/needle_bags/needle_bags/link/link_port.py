"""The real port of openigtlink."""

from __future__ import annotations

import time
from collections.abc import Callable

from needle_bags.link.link_server import LinkServer
from needle_bags.link.openigtlink import Listeners, OpenIGTLinkParameters
from needle_core.component import Batch, Log


class LinkPort:
    """Says to all who listen what it is sent, and tells each time how many they are.

    Parameters
    ----------
    settings : OpenIGTLinkParameters
        Where it listens.

    Attributes
    ----------
    server : LinkServer
        Who says it.

    Raises
    ------
    UserError
        If it cannot listen there.
    """

    def __init__(self, settings: OpenIGTLinkParameters) -> None:
        self.server = LinkServer(settings.address, settings.port)
        self._place = f"{settings.address}, port {self.server.port}"

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Begin; `arrive` takes the events."""
        self._arrive = arrive
        arrive((Log("info", f"shows the needle at {self._place}"),))

    def send(self, batch: tuple[bytes, ...]) -> None:
        """Say whole messages; never waits."""
        now = time.monotonic()
        self.server.turn(now)
        for data in batch:
            self.server.say(data, now)
        self._arrive((Listeners(self.server.listeners, self.server.turned_away),))

    def close(self) -> None:
        """Let all go."""
        self.server.close()
