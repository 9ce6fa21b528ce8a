"""State machine of the simulated operator: preparation, hold and time limits."""

from __future__ import annotations

from collections.abc import Sequence

from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERRUPTED, EXIT_MISSED
from needle_core.component import Call, Exit
from needle_core.process.ros_domain import CONFLICT_HINT
from needle_core.status_messages import ControllerStatus, DeviceStatus

HOME = Call("device/home")
ENABLE = Call("device/enable", True)
START = Call("plane_controller/start")
PREPARATION = (Call("device/confirm_needle_out", True), HOME, ENABLE, START)
DISABLE = Call("device/enable", False)
# Prefix of the refusal by a node that has not discovered all partners; the call is repeated.
NOT_YET = "waiting for"
RETRY_AFTER = 0.1
# Time limits of each step of the preparation, and of steering without progress [s].
WAIT_TIMEOUT, STALL_TIMEOUT = 90.0, 30.0
# An unanswered call is repeated after this time [s]. An answer can be lost: a server that has not
# discovered the client yet drops it silently.
CALL_TIMEOUT = 1.0
# Answer of device/home when homing has started; after any other there is nothing to wait for.
HOMING = "homing"
# Other refusals may be due to delayed messages, so they are repeated for this time [s].
REFUSAL_TIMEOUT = 2.0
_NO_REASON = "no reason given"
# Fields of the controller's status that change while the needle advances.
_PROGRESS = ("state", "step", "insertion_m")


class OperatorSequence:
    """State machine that prepares the rig, presses the hold during steering, and has an outcome.

    Unanswered calls are repeated. Confirming and enabling are idempotent; homing and start are only
    repeated if the statuses do not show that they were accepted.

    All times are monotonic times [s].

    Parameters
    ----------
    now : float
        Time of the start.
    name : str
        Owner of the hold, as in device/status.
    """

    def __init__(self, now: float, name: str) -> None:
        self._name = name
        self._deadline = now + WAIT_TIMEOUT
        self._missing: Sequence[str] = ("everything",)
        self._prepared = 0
        self._pending = False
        self._asked = False
        self._retry_at = now
        self._refusal = ""
        self._refused_since: float | None = None
        self._homed = False
        self._moving = False
        self._simulated = False
        self._device_source = ""
        self._devices: Sequence[str] = ()
        self._homed_since_call = False
        self._homing_seen = False
        self._starts: int | None = None
        self._starts_before = 0
        self._controller = ControllerStatus()
        self._progress_at = now
        self._must_release = False
        self.outcome: Exit | None = None

    @property
    def steering(self) -> bool:
        """Whether the rig is prepared and the run has not ended."""
        return self._prepared == len(PREPARATION) and self.outcome is None

    def hold(self) -> bool:
        """Return whether to press the hold."""
        return self.steering and not self._must_release and self.may_act

    @property
    def touched(self) -> bool:
        """Whether the drives may be enabled, so that they must be disabled at the end."""
        return self._prepared >= 2

    def handle_missing(self, missing: Sequence[str]) -> None:
        """Handle the list of missing partners; empty if all are present."""
        self._missing = missing

    def next_call(self, now: float) -> Call | None:
        """Return the service to call now; pass its answer to `handle_answer`."""
        waits = bool(self._missing) or now < self._retry_at or not self.may_act
        if waits or self.outcome is not None or self._prepared == len(PREPARATION):
            return None
        call = PREPARATION[self._prepared]
        if call == HOME and self._asked and self._moving:
            return None
        if call == ENABLE and not self._homed:
            return None
        if call == START and self._starts is None:
            return None
        self._homed_since_call = False
        if not self._asked:
            self._homing_seen = not self._homed
            self._starts_before = self._starts or 0
        self._asked = self._pending = True
        self._retry_at = now + CALL_TIMEOUT
        return call

    def handle_answer(self, call: Call, success: bool, message: str, now: float) -> None:
        """Handle the answer to `call`; ignore it if the call is completed."""
        wanted = self._prepared < len(PREPARATION) and call == PREPARATION[self._prepared]
        if self.outcome is not None or not wanted:
            return
        self._pending = False
        if success:
            if message == HOMING:
                # Statuses from before the call do not refer to this homing.
                self._homed = self._homed_since_call
            self._advance(now)
            return
        self._refusal = message
        self._retry_at = now + RETRY_AFTER
        if message.startswith(NOT_YET):
            self._refused_since = None
        elif self._refused_since is None:
            self._refused_since = now
        elif now >= self._refused_since + REFUSAL_TIMEOUT:
            self._end(f"{call.service} was refused: {message}")

    def _advance(self, now: float) -> None:
        self._prepared += 1
        self._asked = self._pending = False
        self._retry_at = now
        self._refusal = ""
        self._refused_since = None
        self._deadline = now + WAIT_TIMEOUT
        self._progress_at = now

    def handle_devices(self, names: Sequence[str]) -> None:
        """Handle the publishers of device/status; end the run if there are several."""
        self._devices = names
        if len(names) > 1 and (self._prepared or self._asked):
            self._end(f"there is more than one device: {', '.join(names)}; {CONFLICT_HINT}")

    def handle_device(self, status: DeviceStatus, now: float) -> None:
        """Handle device/status."""
        self._simulated = status.simulated is True
        self._device_source = status.source
        if status.simulated is False:
            self._end(
                f"{status.source} is a real device, or not in simulated time (simulated = "
                "false): a person must hold it, not simulated_operator"
            )
            return
        self._moving = status.state == "MOVING"
        self._homed = status.homed and not self._moving
        self._homed_since_call = self._homed
        self._homing_seen = self._homing_seen or self._moving
        if self._called(HOME) and self._homed and self._homing_seen:
            self._advance(now)
        # The device requires a release before it accepts the press again.
        self._must_release = self.steering and status.press_again == self._name
        if status.state in ("FAULT", "ESTOPPED") and self._prepared:
            self._end(f"device {status.state}: {status.why or _NO_REASON}")

    def handle_controller(self, status: ControllerStatus, now: float) -> None:
        """Handle needle/controller_status."""
        self._starts = status.starts or 0
        started = self._starts > self._starts_before
        if self._called(START) and started:
            # Do not wait for the answer, which may be late or lost.
            self._advance(now)
        before, self._controller = self._controller, status
        if any(getattr(status, name) != getattr(before, name) for name in _PROGRESS):
            self._progress_at = now
        if self.steering and started:
            self._check_end(status)

    def _check_end(self, status: ControllerStatus) -> None:
        why = status.reason or _NO_REASON
        if status.state == "DONE":
            reached = f"inserted {status.insertion_m * 1e3:.1f} mm in {status.step} steps"
            self.outcome = Exit(EXIT_DONE, reached)
        elif status.state == "FAULT":
            self._end(f"plane_controller FAULT: {why}")
        elif status.state == "IDLE":
            self._end(f"plane_controller stopped: {why}")

    def _called(self, call: Call) -> bool:
        """Return whether `call` was made and has not succeeded yet."""
        return self.outcome is None and self._asked and PREPARATION[self._prepared] == call

    def interrupt(self) -> None:
        """Handle a signal that ends the process."""
        if self.outcome is None:
            self.outcome = Exit(EXIT_INTERRUPTED, "interrupted")

    def check_time(self, now: float) -> None:
        """End the run if a time limit is exceeded."""
        if self.outcome is not None:
            return
        if self._prepared < len(PREPARATION):
            if now >= self._deadline:
                self._end(f"the rig is not ready after {WAIT_TIMEOUT:g} s: {self.pending_reason()}")
        elif now >= self._progress_at + STALL_TIMEOUT:
            status = self._controller
            waits = status.state == "WAITING_FOR_TIP" and status.reason
            self._end(
                f"no progress for {STALL_TIMEOUT:g} s at {status.insertion_m * 1e3:.1f} mm "
                f"(plane_controller is {status.state or 'silent'}{f': {waits}' if waits else ''})"
            )

    @property
    def may_act(self) -> bool:
        """Whether the only device reports that it is simulated."""
        return self._simulated and list(self._devices) == [self._device_source]

    def pending_reason(self) -> str:
        """Return the reason why the preparation does not continue."""
        call = PREPARATION[self._prepared].service
        if self._missing:
            return "missing " + ", ".join(self._missing)
        if self._pending:
            return f"no answer from {call}"
        if call == START.service and self._starts is None:
            return "no needle/controller_status received"
        if not self.may_act:
            names = ", ".join(self._devices)
            return f"expected device/status of one simulated device, received it from {names}"
        return self._refusal or f"device/status does not report homed, {call} must wait"

    def _end(self, reason: str) -> None:
        if self.outcome is None:
            is_prepared = self._prepared == len(PREPARATION)
            self.outcome = Exit(EXIT_MISSED if is_prepared else EXIT_BAD_INPUT, reason)
