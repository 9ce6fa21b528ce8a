"""Interface between a page and the rig behind it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from needle_console.view.advice import Button
from needle_console.view.snapshot import Array, Snapshot


@dataclasses.dataclass(frozen=True)
class Desk:
    """The rig as the page knows it; nothing in here waits.

    Attributes
    ----------
    name : str
        Whose hold the console's is.
    snapshot : callable
        Returns the rig as it is now.
    picture : callable
        Returns a side's (`left`, `right`) newest view as JPEG; None where there is none.
    press : callable
        Takes a button; its service is called.
    stop : callable
        Stops whatever moves.
    send_plane, send_point : callable
        Take T_rig_plane, shape (4, 4), or a point in `rig`, shape (3,) [m].
    """

    name: str
    snapshot: Callable[[], Snapshot]
    picture: Callable[[str], bytes | None]
    press: Callable[[Button], None]
    stop: Callable[[], None]
    send_plane: Callable[[Array], None]
    send_point: Callable[[Array], None]
