"""A person's hand, as its source reports it."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Hand:
    """The hand at one moment.

    Attributes
    ----------
    insert : bool
        Whether it holds to insert.
    retract : bool
        Whether it holds to draw the needle out.
    stop : bool
        Whether it asks for a stop.
    speed : float
        Share of the nominal speed that it asks for, 0..1.
    """

    insert: bool = False
    retract: bool = False
    stop: bool = False
    speed: float = 1.0

    @property
    def is_neutral(self) -> bool:
        """Whether it touches nothing that could move the needle or stop it."""
        return not (self.insert or self.retract or self.stop)


@dataclasses.dataclass(frozen=True)
class Lost:
    """There is no source that could tell what the hand does.

    Attributes
    ----------
    why : str
        What is wrong with it.
    """

    why: str


Reading = Hand | Lost
