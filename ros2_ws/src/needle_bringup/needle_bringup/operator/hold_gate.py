"""Which press of a hand counts: a fresh one, after nothing was held."""

from __future__ import annotations

import dataclasses
import enum

from needle_bringup.operator.hand import Lost, Reading

# Between two looks no more than this may pass: then this process itself stood still [s].
LONGEST_GAP = 0.1


class Held(enum.Enum):
    """Purpose of a press that counts."""

    NOTHING = "nothing"
    INSERT = "insert"
    RETRACT = "retract"


@dataclasses.dataclass(frozen=True)
class Grip:
    """The part of a hand's reading that counts.

    Attributes
    ----------
    held : Held
        What is held.
    speed : float
        Share of the nominal speed, 0..1.
    stop : bool
        Whether a stop was asked for just now.
    trouble : str
        Why there is no hand to follow; empty: there is one.
    unheeded : bool
        Whether something is held that does not count before all is let go of.
    """

    held: Held = Held.NOTHING
    speed: float = 0.0
    stop: bool = False
    trouble: str = ""
    unheeded: bool = False


class HoldGate:
    """Lets a press through that came fresh out of neutral, and as long as it lasts.

    After the start, a loss of the source, a stop, two buttons at once, or a standstill of this
    process the hand must be seen neutral first; what is held meanwhile never begins to count by
    itself.
    """

    def __init__(self) -> None:
        self._held = Held.NOTHING
        self._armed = False
        self._stopping = False
        self._looked: float | None = None

    def take(self, reading: Reading, now: float) -> Grip:
        """Return what counts of a reading at this time of the steady clock [s]."""
        gap = 0.0 if self._looked is None else now - self._looked
        self._looked = now
        if isinstance(reading, Lost):
            self._let_go()
            self._stopping = False
            return Grip(trouble=reading.why)
        if gap > LONGEST_GAP:
            self._let_go()
        asked, self._stopping = reading.stop and not self._stopping, reading.stop
        if reading.is_neutral:
            self._held, self._armed = Held.NOTHING, True
            return Grip(speed=reading.speed)
        if reading.stop or (reading.insert and reading.retract):
            self._let_go()
            return Grip(speed=reading.speed, stop=asked, unheeded=not reading.stop)
        wanted = Held.INSERT if reading.insert else Held.RETRACT
        if self._armed:
            self._held, self._armed = wanted, False
        elif self._held is not wanted:
            self._let_go()
        return Grip(self._held, reading.speed, unheeded=self._held is Held.NOTHING)

    def _let_go(self) -> None:
        self._held, self._armed = Held.NOTHING, False
