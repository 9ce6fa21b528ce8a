"""Drawing the needle out by a held button: the calls that it takes, in their order."""

from __future__ import annotations

import enum

STOP_STEERING = "plane_controller/stop"
RETRACT = "device/retract"
# So long an answer, or what must follow it, is waited for [s].
PATIENCE = 1.0
_RETRACTION = "retraction"


class _Phase(enum.Enum):
    IDLE = enum.auto()
    STEERING_ENDS = enum.auto()
    HOLD_COUNTS = enum.auto()
    DEVICE_ANSWERS = enum.auto()
    NEEDLE_LEAVES = enum.auto()
    RETRACTING = enum.auto()
    OVER = enum.auto()


# What to say where the next thing does not come.
_IN_VAIN = {
    _Phase.STEERING_ENDS: f"no answer from {STOP_STEERING}",
    _Phase.HOLD_COUNTS: "the device does not take the hold (device/status says why)",
    _Phase.DEVICE_ANSWERS: f"no answer from {RETRACT}",
    _Phase.NEEDLE_LEAVES: "nothing is drawn out: the needle is out",
}


class RetractionSequence:
    """From the press of the button to its release.

    A controller that steers would answer the hold with a step forward: it is told to stop first.
    The hold is given while the needle is drawn out, and ends with that: who goes on holding the
    button when the needle is out holds nothing that could insert it.

    Parameters
    ----------
    name : str
        Whose hold it is, as the device knows it.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._phase = _Phase.IDLE
        self._since = 0.0
        self._call: str | None = None
        self._owner = ""
        self._activity = ""
        self.trouble = ""

    @property
    def holds(self) -> bool:
        """Whether the hold is to be pressed."""
        return self._phase in (
            _Phase.HOLD_COUNTS,
            _Phase.DEVICE_ANSWERS,
            _Phase.NEEDLE_LEAVES,
            _Phase.RETRACTING,
        )

    def see_device(self, owner: str, activity: str, now: float) -> None:
        """Take who holds, and what is under way, as device/status says them."""
        self._owner, self._activity = owner, activity
        if self._phase is _Phase.HOLD_COUNTS and owner == self._name:
            self._go(_Phase.DEVICE_ANSWERS, now, call=RETRACT)
        elif self._phase is _Phase.NEEDLE_LEAVES and activity == _RETRACTION:
            self._go(_Phase.RETRACTING, now)
        elif self._phase is _Phase.RETRACTING and activity != _RETRACTION:
            self._go(_Phase.OVER, now)

    def take_answer(self, service: str, success: bool, message: str, now: float) -> None:
        """Take the answer to a call; one that comes too late changes nothing."""
        if self._phase is _Phase.STEERING_ENDS and service == STOP_STEERING:
            if success:
                self._go(_Phase.HOLD_COUNTS, now)
            else:
                self._give_up(f"{service} was refused: {message}", now)
        elif self._phase is _Phase.DEVICE_ANSWERS and service == RETRACT:
            if success:
                self._go(_Phase.NEEDLE_LEAVES, now)
                self.see_device(self._owner, self._activity, now)
            else:
                self._give_up(f"{service} was refused: {message}", now)

    def look(self, held: bool, now: float, *, controller: bool) -> str | None:
        """Go on with what the button wants.

        Parameters
        ----------
        held : bool
            Whether the button is held, and counts.
        now : float
            Steady time [s].
        controller : bool
            Whether there is a controller that might steer.

        Returns
        -------
        str or None
            The service to call now; its answer goes to `take_answer`.
        """
        if not held:
            self._phase, self._call, self.trouble = _Phase.IDLE, None, ""
            return None
        if self._phase is _Phase.IDLE and controller:
            self._go(_Phase.STEERING_ENDS, now, call=STOP_STEERING)
        elif self._phase is _Phase.IDLE:
            self._go(_Phase.HOLD_COUNTS, now)
        elif self._phase in _IN_VAIN and now - self._since > PATIENCE:
            self._give_up(_IN_VAIN[self._phase], now)
        call, self._call = self._call, None
        return call

    def _give_up(self, trouble: str, now: float) -> None:
        self._go(_Phase.OVER, now)
        self.trouble = trouble

    def _go(self, phase: _Phase, now: float, call: str | None = None) -> None:
        self._phase, self._since, self._call = phase, now, call
