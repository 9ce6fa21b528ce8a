"""Readings of an input device; only a press after a release of all buttons counts as a hold."""

from __future__ import annotations

import dataclasses
import enum

# A longer gap between two readings means that this process was suspended [s].
MAX_GAP = 0.1


@dataclasses.dataclass(frozen=True)
class InputState:
    """State of the controls at one moment.

    Attributes
    ----------
    insert, retract, stop : bool
        Whether the button is down.
    speed : float
        Requested share of the nominal speed, 0..1.
    """

    insert: bool = False
    retract: bool = False
    stop: bool = False
    speed: float = 1.0

    @property
    def is_neutral(self) -> bool:
        """Whether no button is down."""
        return not (self.insert or self.retract or self.stop)


@dataclasses.dataclass(frozen=True)
class InputLost:
    """The input device is unavailable.

    Attributes
    ----------
    reason : str
        Reason why it is unavailable.
    """

    reason: str


InputReading = InputState | InputLost


class HoldKind(enum.Enum):
    """Purpose of an accepted press."""

    NOTHING = "nothing"
    INSERT = "insert"
    RETRACT = "retract"


@dataclasses.dataclass(frozen=True)
class HoldDecision:
    """The accepted part of an input reading.

    Attributes
    ----------
    kind : HoldKind
        The accepted hold.
    speed : float
        Share of the nominal speed, 0..1.
    stop : bool
        Whether a stop was just requested.
    problem : str
        Reason why there is no input; empty if there is input.
    ignored_press : bool
        Whether a button is down but ignored until all buttons are released.
    """

    kind: HoldKind = HoldKind.NOTHING
    speed: float = 0.0
    stop: bool = False
    problem: str = ""
    ignored_press: bool = False


class HoldDebouncer:
    """Accepts a press that starts from neutral, for as long as it lasts.

    After the start, a loss of the input device, a stop, two buttons at once, or a suspension of
    this process, the controls must be neutral first, so that a button that stayed down never
    becomes a hold by itself.
    """

    def __init__(self) -> None:
        self._kind = HoldKind.NOTHING
        self._armed = False
        self._stopping = False
        self._read_at: float | None = None

    def update(self, reading: InputReading, now: float) -> HoldDecision:
        """Return the accepted part of a reading at this steady time [s]."""
        gap = 0.0 if self._read_at is None else now - self._read_at
        self._read_at = now
        if isinstance(reading, InputLost):
            self._release()
            self._stopping = False
            return HoldDecision(problem=reading.reason)
        if gap > MAX_GAP:
            self._release()
        new_stop, self._stopping = reading.stop and not self._stopping, reading.stop
        if reading.is_neutral:
            self._kind, self._armed = HoldKind.NOTHING, True
            return HoldDecision(speed=reading.speed)
        if reading.stop or (reading.insert and reading.retract):
            self._release()
            return HoldDecision(speed=reading.speed, stop=new_stop, ignored_press=not reading.stop)
        pressed = HoldKind.INSERT if reading.insert else HoldKind.RETRACT
        if self._armed:
            self._kind, self._armed = pressed, False
        elif self._kind is not pressed:
            self._release()
        ignored = self._kind is HoldKind.NOTHING
        return HoldDecision(self._kind, reading.speed, ignored_press=ignored)

    def _release(self) -> None:
        self._kind, self._armed = HoldKind.NOTHING, False
