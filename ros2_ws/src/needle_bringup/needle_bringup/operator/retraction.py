"""Withdrawal of the needle while a button is held: sequence of the required service calls."""

from __future__ import annotations

import enum

STOP_STEERING = "plane_controller/stop"
RETRACT = "device/retract"
# Time limit for an answer, and for its effect [s].
STEP_TIMEOUT = 1.0
_RETRACTION = "retraction"


class _Phase(enum.Enum):
    IDLE = enum.auto()
    STEERING_ENDS = enum.auto()
    HOLD_COUNTS = enum.auto()
    DEVICE_ANSWERS = enum.auto()
    NEEDLE_LEAVES = enum.auto()
    RETRACTING = enum.auto()
    OVER = enum.auto()


# Phase after the answer of a service.
_AFTER_ANSWER = {
    (_Phase.STEERING_ENDS, STOP_STEERING): _Phase.HOLD_COUNTS,
    (_Phase.DEVICE_ANSWERS, RETRACT): _Phase.NEEDLE_LEAVES,
}
# Error text if a phase times out.
_TIMEOUT_TEXT = {
    _Phase.STEERING_ENDS: f"no answer from {STOP_STEERING}",
    _Phase.HOLD_COUNTS: "the device ignores the hold (see the reason in device/status)",
    _Phase.DEVICE_ANSWERS: f"no answer from {RETRACT}",
    _Phase.NEEDLE_LEAVES: "nothing to withdraw: the needle is out",
}


class RetractionSequence:
    """State machine from the press of the button to its release.

    An active steering controller would respond to the hold with a step forward, so it is stopped
    first. The hold is pressed only during the withdrawal, so that a button that is still held when
    the needle is out cannot insert it.

    Parameters
    ----------
    name : str
        Owner of the hold, as in device/status.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._phase = _Phase.IDLE
        self._since = 0.0
        self._call: str | None = None
        self._owner = ""
        self._activity = ""
        self.problem = ""

    @property
    def holds(self) -> bool:
        """Whether to press the hold."""
        return self._phase not in (_Phase.IDLE, _Phase.STEERING_ENDS, _Phase.OVER)

    def handle_device(self, owner: str, activity: str, now: float) -> None:
        """Handle the owner of the hold and the activity in device/status."""
        self._owner, self._activity = owner, activity
        if self._phase is _Phase.HOLD_COUNTS and owner == self._name:
            self._enter(_Phase.DEVICE_ANSWERS, now, call=RETRACT)
        elif self._phase is _Phase.NEEDLE_LEAVES and activity == _RETRACTION:
            self._enter(_Phase.RETRACTING, now)
        elif self._phase is _Phase.RETRACTING and activity != _RETRACTION:
            self._enter(_Phase.OVER, now)

    def handle_answer(self, service: str, success: bool, message: str, now: float) -> None:
        """Handle the answer to a call; ignore a late one."""
        following = _AFTER_ANSWER.get((self._phase, service))
        if following is None:
            return
        if not success:
            self._give_up(f"{service} was refused: {message}", now)
            return
        self._enter(following, now)
        if following is _Phase.NEEDLE_LEAVES:
            self.handle_device(self._owner, self._activity, now)

    def update(self, held: bool, now: float, *, controller: bool) -> str | None:
        """Update the sequence with the state of the button.

        Parameters
        ----------
        held : bool
            Whether the button is held.
        now : float
            Steady time [s].
        controller : bool
            Whether a controller is present.

        Returns
        -------
        str or None
            The service to call now; pass its answer to `handle_answer`.
        """
        if not held:
            self._phase, self._call, self.problem = _Phase.IDLE, None, ""
            return None
        if self._phase is _Phase.IDLE and controller:
            self._enter(_Phase.STEERING_ENDS, now, call=STOP_STEERING)
        elif self._phase is _Phase.IDLE:
            self._enter(_Phase.HOLD_COUNTS, now)
        elif self._phase in _TIMEOUT_TEXT and now - self._since > STEP_TIMEOUT:
            self._give_up(_TIMEOUT_TEXT[self._phase], now)
        call, self._call = self._call, None
        return call

    def _give_up(self, problem: str, now: float) -> None:
        self._enter(_Phase.OVER, now)
        self.problem = problem

    def _enter(self, phase: _Phase, now: float, call: str | None = None) -> None:
        self._phase, self._since, self._call = phase, now, call
