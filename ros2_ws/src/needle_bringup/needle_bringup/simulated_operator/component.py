"""simulated_operator as a component: operates a simulated rig in place of a person."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from needle_core import messages as m
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERRUPTED, EXIT_MISSED
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Actions,
    Answer,
    Call,
    Component,
    Diagnose,
    Exit,
    Input,
    Moment,
    Output,
    Peers,
    Publish,
    Send,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import HoldSession
from needle_core.process.ros_domain import CONFLICT_HINT
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_core.status_messages import ControllerStatus, DeviceStatus

HOLD, PROGRESS = "device/hold", "progress"
RECORDER, PARAMETERS_OF = "recorder", "parameters_of"
_CONTROLLER, _DEVICE = "needle/controller_status", "device/status"
HOLD_PERIOD = 0.05
"""Period of device/hold, which the device requires every 0.1 s [s]."""
# Number of final release messages, as delivery of the hold is best effort.
_RELEASES = 3

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
_PROGRESS_FIELDS = ("state", "step", "insertion_m")


@dataclasses.dataclass(frozen=True)
class SimulatedOperatorParameters:
    """Parameters of simulated_operator."""

    wait_for_recorder: bool = fixed_parameter(
        False, "-", "Wait until the recorder has the parameters of all nodes."
    )

    def __post_init__(self) -> None:
        check_fields(self)


class SimulatedOperator(Component):
    """Prepares the rig, presses the hold during steering, and disables the device at the end.

    Unanswered calls are repeated. Confirming and enabling are idempotent; homing and start are only
    repeated if the statuses do not show that they were accepted.

    Parameters
    ----------
    settings : SimulatedOperatorParameters
        The node's parameters.
    name : str
        Full name of the node, which identifies the owner of the hold.
    now : float
        Steady time [s].
    """

    name = "simulated_operator"

    def __init__(
        self, settings: SimulatedOperatorParameters, name: str = name, now: float = 0.0
    ) -> None:
        self.name, self.settings = name, settings
        self._session = HoldSession(name)
        self._missing: Sequence[str] = ("everything",)
        self._unrecorded: Sequence[str] = ("recorder",) if settings.wait_for_recorder else ()
        self._nodes: frozenset[str] = frozenset()
        self._devices: Sequence[str] = ()
        self._device = DeviceStatus()
        self._controller: ControllerStatus | None = None
        self._prepared = 0
        self._begin_step(now)
        self._homed = False
        self._homed_since_call = False
        self._homing_seen = False
        self._starts_before = 0
        self._must_release = False
        self._outcome: Exit | None = None
        self._is_finished = False
        self.inputs = (
            Input(_CONTROLLER, ControllerStatus, self._on_controller, LATCHED),
            Input(_DEVICE, DeviceStatus, self._on_device, LATCHED),
        )
        if settings.wait_for_recorder:
            self.inputs += (Input("/diagnostics", m.Diagnostics, self._on_health),)
        self.outputs = (Output(HOLD, m.HoldState, BEST_EFFORT),)
        self.timers = (Timer(HOLD_PERIOD, self._on_timer),)

    # ---- events ---------------------------------------------------------------------------------

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Update the missing nodes and services; end the run if there are several devices."""
        self._devices = peers.publishers.get(_DEVICE, ())
        if len(self._devices) > 1 and (self._prepared or self._asked):
            self._end(f"there is more than one device: {', '.join(self._devices)}; {CONFLICT_HINT}")
        missing = [
            f"service {call.service}" for call in PREPARATION if call.service not in peers.services
        ]
        for topic in (_CONTROLLER, _DEVICE):
            if topic not in peers.publishers:
                missing.append(f"publisher of {topic}")
        if HOLD not in peers.subscribers:
            missing.append(f"subscriber of {HOLD}")
        self._missing, self._nodes = missing, peers.nodes
        return ()

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Handle the answer to the last call; exit after the final call."""
        if self._is_finished:
            return self._exit() if answer.service == DISABLE.service else ()
        call = self._next_step
        if call is None or call.service != answer.service or not answer.answered:
            return ()
        if self._outcome is None:
            self._handle_answer(call, answer, at.steady)
        return self._advance(at)

    def on_stop(self, at: Moment) -> Actions:
        """Release, disable, and exit as interrupted."""
        self._outcome = self._outcome or Exit(EXIT_INTERRUPTED, "interrupted")
        if self._is_finished:
            # The signal also ends the other nodes, so they do not answer.
            return (Exit(EXIT_INTERRUPTED, self._outcome.text),)
        return self._advance(at)

    def _on_controller(self, message: ControllerStatus, at: Moment) -> Actions:
        before, self._controller = self._controller or ControllerStatus(), message
        started = self._starts > self._starts_before
        if self._is_called(START) and started:
            # Do not wait for the answer, which may be late or lost.
            self._complete_step(at.steady)
        if any(getattr(message, name) != getattr(before, name) for name in _PROGRESS_FIELDS):
            self._progress_at = at.steady
        if self._is_steering and started:
            self._check_end(message)
        if self._is_steering:
            yield Send(PROGRESS, (message,))
        yield from self._advance(at)

    def _on_device(self, message: DeviceStatus, at: Moment) -> Actions:
        self._device = message
        if message.simulated is False:
            self._end(
                f"{message.source} is a real device, or not in simulated time (simulated = "
                "false): a person must hold it, not simulated_operator"
            )
            return self._advance(at)
        self._homed = self._homed_since_call = message.homed and not self._is_moving
        self._homing_seen = self._homing_seen or self._is_moving
        if self._is_called(HOME) and self._homed and self._homing_seen:
            self._complete_step(at.steady)
        # The device requires a release before it accepts the press again.
        self._must_release = self._is_steering and message.press_again == self.name
        if message.state in ("FAULT", "ESTOPPED") and self._prepared:
            self._end(f"device {message.state}: {message.why or _NO_REASON}")
        return self._advance(at)

    def _on_health(self, message: m.Diagnostics, at: Moment) -> Actions:
        """Update the nodes whose parameters are not in the bag yet; a rerun needs them."""
        for status in message.statuses:
            if status.part == PARAMETERS_OF and status.source.rpartition("/")[2] == RECORDER:
                recorded = {name.lstrip("/") for name in status.text.split(", ")}
                missing = sorted(self._nodes - recorded)
                self._unrecorded = [f"recorder of {name}'s parameters" for name in missing]
        return ()

    def _on_timer(self, at: Moment) -> Actions:
        # Publish releases as well: the device accepts a press only after a release.
        if self._may_act and not self._is_finished:
            yield self._hold(at, pressed=self._is_steering and not self._must_release)
        self._check_time(at.steady)
        yield from self._advance(at)

    # ---- preparation ----------------------------------------------------------------------------

    @property
    def _next_step(self) -> Call | None:
        """The next call of the preparation; None after the last."""
        return PREPARATION[self._prepared] if self._prepared < len(PREPARATION) else None

    @property
    def _is_steering(self) -> bool:
        """Whether the rig is prepared and the run has not ended."""
        return self._next_step is None and self._outcome is None

    @property
    def _may_act(self) -> bool:
        """Whether the only device reports that it is simulated."""
        return self._device.simulated is True and list(self._devices) == [self._device.source]

    @property
    def _is_moving(self) -> bool:
        return self._device.state == "MOVING"

    @property
    def _starts(self) -> int:
        """Number of starts that the controller has reported."""
        return 0 if self._controller is None else self._controller.starts or 0

    def _is_called(self, call: Call) -> bool:
        """Return whether `call` was made and has not succeeded yet."""
        return self._outcome is None and self._asked and self._next_step == call

    def _begin_step(self, now: float) -> None:
        """Begin a step of the preparation, or the steering after the last."""
        self._asked = self._is_unanswered = False
        self._refusal = ""
        self._refused_since: float | None = None
        self._retry_at = self._progress_at = now
        self._deadline = now + WAIT_TIMEOUT

    def _complete_step(self, now: float) -> None:
        self._prepared += 1
        self._begin_step(now)

    def _call(self, now: float) -> Actions:
        """Call the service of the next step, if it is due."""
        call, is_waiting = self._next_step, self._missing or self._unrecorded
        if call is None or is_waiting or now < self._retry_at or not self._may_act:
            return
        if (
            (call == HOME and self._asked and self._is_moving)
            or (call == ENABLE and not self._homed)
            or (call == START and self._controller is None)
        ):
            return
        self._homed_since_call = False
        if not self._asked:
            self._homing_seen = not self._homed
            self._starts_before = self._starts
        self._asked = self._is_unanswered = True
        self._retry_at = now + CALL_TIMEOUT
        yield call

    def _handle_answer(self, call: Call, answer: Answer, now: float) -> None:
        self._is_unanswered = False
        if answer.success:
            if answer.text == HOMING:
                # Statuses from before the call do not refer to this homing.
                self._homed = self._homed_since_call
            self._complete_step(now)
            return
        self._refusal = answer.text
        self._retry_at = now + RETRY_AFTER
        if answer.text.startswith(NOT_YET):
            self._refused_since = None
        elif self._refused_since is None:
            self._refused_since = now
        elif now >= self._refused_since + REFUSAL_TIMEOUT:
            self._end(f"{call.service} was refused: {answer.text}")

    def _pending_reason(self, call: Call) -> str:
        """Return the reason why the preparation does not continue."""
        if self._missing or self._unrecorded:
            return "missing " + ", ".join([*self._missing, *self._unrecorded])
        if self._is_unanswered:
            return f"no answer from {call.service}"
        if call == START and self._controller is None:
            return "no needle/controller_status received"
        if not self._may_act:
            names = ", ".join(self._devices)
            return f"expected device/status of one simulated device, received it from {names}"
        return self._refusal or f"device/status does not report homed, {call.service} must wait"

    # ---- end ------------------------------------------------------------------------------------

    def _check_end(self, status: ControllerStatus) -> None:
        why = status.reason or _NO_REASON
        if status.state == "DONE":
            reached = f"inserted {status.insertion_m * 1e3:.1f} mm in {status.step} steps"
            self._outcome = Exit(EXIT_DONE, reached)
        elif status.state == "FAULT":
            self._end(f"plane_controller FAULT: {why}")
        elif status.state == "IDLE":
            self._end(f"plane_controller stopped: {why}")

    def _check_time(self, now: float) -> None:
        """End the run if a time limit is exceeded."""
        call, status = self._next_step, self._controller
        if call is not None and now >= self._deadline:
            why = self._pending_reason(call)
            self._end(f"the rig is not ready after {WAIT_TIMEOUT:g} s: {why}")
        elif call is None and status is not None and now >= self._progress_at + STALL_TIMEOUT:
            waits = status.state == "WAITING_FOR_TIP" and status.reason
            self._end(
                f"no progress for {STALL_TIMEOUT:g} s at {status.insertion_m * 1e3:.1f} mm "
                f"(plane_controller is {status.state or 'silent'}{f': {waits}' if waits else ''})"
            )

    def _end(self, reason: str) -> None:
        if self._outcome is None:
            code = EXIT_MISSED if self._next_step is None else EXIT_BAD_INPUT
            self._outcome = Exit(code, reason)

    def _advance(self, at: Moment) -> Actions:
        """Call the next service, or finish the run."""
        if self._is_finished:
            return
        if self._outcome is not None:
            yield from self._finish(at)
            return
        yield from self._call(at.steady)
        yield self._report()

    def _finish(self, at: Moment) -> Actions:
        self._is_finished = True
        if self._prepared < PREPARATION.index(ENABLE):
            # The drives are still disabled.
            yield from self._exit()
            return
        for _ in range(_RELEASES):
            yield self._hold(at, pressed=False)
        yield self._report()
        yield DISABLE

    def _exit(self) -> Actions:
        assert self._outcome is not None
        yield self._outcome

    def _hold(self, at: Moment, *, pressed: bool) -> Publish:
        return Publish(HOLD, self._session.next_message(at.stamp_ns, pressed=pressed, speed=1.0))

    def _report(self) -> Diagnose:
        if self._is_steering:
            message = "the hold is pressed"
        elif self._outcome is not None:
            message = "the hold is released"
        else:
            message = "prepares the rig"
        return Diagnose("hold", Diagnostic(Level.OK, message))
