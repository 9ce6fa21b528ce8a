"""Progress of simulated time and times of exposures, if nobody waits for real time."""

from __future__ import annotations

import enum

_STEERING = ("STEERING", "WAITING_FOR_TIP")
# So many exposures in a row may pass without a step: hands that block both cameras take half of it.
MAX_WITHOUT_STEP = 60


class Action(enum.Enum):
    """Next step of the simulation."""

    TICK = "tick"
    EXPOSE = "expose"
    WAIT = "wait"


class LockStep:
    """Lets time go on only where the graph has answered, so that a run repeats bit for bit.

    Parameters
    ----------
    answered : bool
        Whether each exposure gets an answer (a tracker's tip pose) that must be waited for.
    reexpose_after : float
        Silence after which a steered, held needle is exposed again [s], steady clock.
    """

    def __init__(self, *, answered: bool, reexpose_after: float) -> None:
        self._answered = answered
        self._reexpose_after = reexpose_after
        self._last_exposure_ns = -1
        self._unanswered = False
        self._step_ended = False
        self._tip_lost = False
        self._state = ""
        self._tip_wanted_after_ns: int | None = None
        self._heard_at = 0.0
        self.watchdog_trips = 0
        self._without_step = 0

    @property
    def why_stuck(self) -> str:
        """Reason why the needle will not go on; empty while it may."""
        if self._without_step < MAX_WITHOUT_STEP:
            return ""
        tip = "no tip was found" if self._tip_lost else "no tip led to one"
        return f"{self._without_step} exposures since the last step, and {tip}"

    def step_ended(self, now: float) -> None:
        """Take the end of a step, whether it succeeded or was aborted."""
        self._step_ended = True
        self._without_step = 0
        self._heard_at = now

    def take_controller_status(
        self, state: str, awaiting: str, tip_after_ns: int, now: float
    ) -> None:
        """Take the controller's state, what it waits for, and after which stamp it wants a tip."""
        self._state = state
        if state not in _STEERING:
            self._without_step = 0
        self._tip_wanted_after_ns = tip_after_ns if awaiting == "tip" else None
        self._heard_at = now

    def take_answer(self, stamp_ns: int, found: bool, now: float) -> None:
        """Take what the tracker found in the exposure of `stamp_ns`."""
        if stamp_ns != self._last_exposure_ns:
            return
        self._unanswered = False
        self._tip_lost = not found
        self._without_step += self._state in _STEERING
        self._heard_at = now

    def exposed(self, stamp_ns: int, now: float) -> None:
        """Take that an exposure was made with `stamp_ns`."""
        self._last_exposure_ns = stamp_ns
        self._unanswered = self._answered
        self._step_ended = False
        self._tip_lost = False
        self._heard_at = now

    def next_action(self, *, under_way: bool, may_move: bool, held: bool, now: float) -> Action:
        """Return what to do next.

        Parameters
        ----------
        under_way : bool
            Whether a step, retraction or homing is under way.
        may_move : bool
            Whether it would go on now (hold fresh, speed not 0).
        held : bool
            Whether somebody's fresh hold counts.
        now : float
            Steady time [s].
        """
        if under_way:
            return Action.TICK if may_move else Action.WAIT
        tip_wanted = (
            self._tip_wanted_after_ns is not None
            and self._tip_wanted_after_ns >= self._last_exposure_ns
        )
        lost = self._tip_lost and self._state in _STEERING
        due = not self._unanswered and (self._step_ended or tip_wanted or lost)
        if due:
            return Action.EXPOSE
        silent = now - self._heard_at >= self._reexpose_after
        if held and silent and self._state in _STEERING:
            self.watchdog_trips += 1
            return Action.EXPOSE
        return Action.WAIT
