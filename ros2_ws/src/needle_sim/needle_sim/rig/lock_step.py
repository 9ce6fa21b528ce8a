"""Progress of simulated time and times of exposures, if nobody waits for real time."""

from __future__ import annotations

import enum
from collections import deque

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
    tick_ns, frame_ns : int
        Length of a tick, and time between two exposures of a needle that goes in continuously [ns].
    path_delay_ns : int
        How long after its exposure the answer to one takes effect then [ns].
    """

    def __init__(
        self,
        *,
        answered: bool,
        reexpose_after: float,
        tick_ns: int,
        frame_ns: int,
        path_delay_ns: int,
    ) -> None:
        self._tick_ns = tick_ns
        self._frame_ns = frame_ns
        self._path_delay_ns = path_delay_ns
        self._continuous = False
        self._next_frame_ns = 0
        # Exposures of a needle that goes in continuously whose answer has not come.
        self._open: deque[int] = deque()
        self._command_ns = 0
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
        self,
        state: str,
        awaiting: str,
        tip_after_ns: int,
        now: float,
        *,
        continuous: bool = False,
        command_ns: int = 0,
    ) -> None:
        """Take the controller's state, what it waits for, and after which stamp it wants a tip.

        Of continuous insertion also the stamp of the command that it sent last.
        """
        self._state = state
        if state not in _STEERING:
            self._without_step = 0
        self._tip_wanted_after_ns = tip_after_ns if awaiting == "tip" else None
        self._continuous = continuous
        self._command_ns = command_ns
        while self._open and self._open[0] <= tip_after_ns:
            self._open.popleft()
        self._heard_at = now

    def take_answer(self, stamp_ns: int, found: bool, now: float) -> None:
        """Take what the tracker found in the exposure of `stamp_ns`."""
        if stamp_ns != self._last_exposure_ns:
            return
        self._unanswered = False
        self._tip_lost = not found
        if not found and stamp_ns in self._open:
            self._open.remove(stamp_ns)
        self._without_step += self._state in _STEERING
        self._heard_at = now

    def exposed(self, stamp_ns: int, now: float) -> None:
        """Take that an exposure was made with `stamp_ns`."""
        self._last_exposure_ns = stamp_ns
        self._unanswered = self._answered
        self._step_ended = False
        self._tip_lost = False
        self._heard_at = now
        if self._continuous:
            self._open.append(stamp_ns)
            self._next_frame_ns = stamp_ns + self._frame_ns

    def next_action(
        self,
        *,
        time_ns: int,
        heard_command_ns: int,
        under_way: bool,
        may_move: bool,
        held: bool,
        now: float,
    ) -> Action:
        """Return what to do next.

        Parameters
        ----------
        time_ns : int
            Simulated time [ns].
        heard_command_ns : int
            Stamp of the newest command that the device has heard [ns].
        under_way : bool
            Whether a step, retraction or homing is under way.
        may_move : bool
            Whether it would go on now (hold fresh, speed not 0).
        held : bool
            Whether somebody's hold counts.
        now : float
            Steady time [s].
        """
        if not held:
            # Silence counts from when somebody holds.
            self._heard_at = now
        if self._continuous and self._tip_wanted_after_ns is not None:
            # Frames of a needle that is paused would come as often as the pause is long.
            if not held or (under_way and not may_move):
                return Action.WAIT
            return self._next_of_continuous(time_ns + self._tick_ns, heard_command_ns, now)
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
        if silent and self._state in _STEERING:
            self.watchdog_trips += 1
            return Action.EXPOSE
        return Action.WAIT

    def _next_of_continuous(self, then_ns: int, heard_command_ns: int, now: float) -> Action:
        """Let time go on up to where the answer to an exposure is due that has not come."""
        if heard_command_ns < self._command_ns or (
            self._open and then_ns >= self._open[0] + self._path_delay_ns
        ):
            if now - self._heard_at < self._reexpose_after:
                return Action.WAIT
            self.watchdog_trips += 1
            self._command_ns = 0
            self._open.clear()
        return Action.EXPOSE if then_ns >= self._next_frame_ns else Action.TICK
