"""Connection to drives as a component uses it, and its errors."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, ClassVar

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.rules import Rule


class LinkError(Exception):
    """The link cannot be opened or is lost; the text names the link and the reason."""


class DriveError(Exception):
    """A drive does not answer, or refuses an access; the text names the entry and the reason."""


@contextlib.contextmanager
def raised_as_axis_error(axis: str) -> Iterator[None]:
    """Raise link and drive errors as an `AxisError` of this axis."""
    try:
        yield
    except (LinkError, DriveError) as error:
        rule = Rule.LINK_LOSS if isinstance(error, LinkError) else Rule.ONE_FAULT_STOPS_BOTH
        raise AxisError(f"{axis} axis: {error}", rule) from error


class Link:
    """One connection, which can be opened, lost and opened again.

    A lost link stays lost until `open` is called, because the drives have missed orders.

    Parameters
    ----------
    name : str
        Name of the link in messages.

    Attributes
    ----------
    now : float
        Steady time of the running handler [s].
    lost : str
        Reason why the link was lost; empty: it was not.
    openings : int
        Number of times the link was opened.
    """

    _counters: ClassVar[tuple[str, ...]] = ()

    def __init__(self, name: str) -> None:
        self.name = name
        self.now = 0.0
        self.lost = ""
        self.openings = 0
        self._is_open = False
        self._port_error = ""

    @property
    def is_open(self) -> bool:
        """Whether it is open and not lost."""
        return self._is_open and not self.lost

    @property
    def counts(self) -> dict[str, str]:
        """Counters for diagnostics, by name."""
        return {name: str(getattr(self, name)) for name in self._counters}

    def open(self) -> None:
        """Open the link, or reopen it after a loss.

        Raises
        ------
        LinkError
            If the port is not open.
        """
        if self.is_open:
            return
        if self._port_error:
            raise LinkError(f"cannot open {self.name}: {self._port_error}")
        self._is_open = True
        self.lost = ""
        self.openings += 1
        self._restart()

    def set_port_error(self, error: str) -> None:
        """Note why the port is not open; empty: it is open."""
        self._port_error = error
        if error and self.is_open:
            self.lost = f"link {self.name} is lost: {error}"

    def close(self) -> None:
        """Close the link."""
        self._is_open = False

    def pop_outgoing(self) -> tuple[Any, ...]:
        """Return the data sent since the last call."""
        raise NotImplementedError

    def _restart(self) -> None:
        """Discard the state of the earlier connection."""

    def _require_open(self) -> None:
        """Raise `LinkError` if the link is closed or lost."""
        if not self.is_open:
            raise LinkError(self.lost or f"{self.name} is not open")
