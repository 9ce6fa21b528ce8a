"""Errors of drives and of their connection, and their form for the motion supervisor."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from needle_device_driver.axes.axis import AxisError
from needle_device_driver.rules import Rule


class LinkError(Exception):
    """The link cannot be opened or is lost; the text names the link and the reason."""


class DriveError(Exception):
    """A drive does not answer, or refuses; the text names the entry and the reason."""


@contextlib.contextmanager
def raised_as_axis_error(axis: str) -> Iterator[None]:
    """Raise errors of link and drive as an `AxisError` of this axis."""
    try:
        yield
    except (LinkError, DriveError) as error:
        rule = Rule.LINK_LOSS if isinstance(error, LinkError) else Rule.ONE_FAULT_STOPS_BOTH
        raise AxisError(f"{axis} axis: {error}", rule) from error
