"""simulated_operator as a component: presses the hold of a simulated rig in place of a person."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from needle_bringup.simulated_operator.operator_sequence import (
    DISABLE,
    PREPARATION,
    OperatorSequence,
)
from needle_core import messages as m
from needle_core.commands.cli import EXIT_INTERRUPTED
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
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_core.status_messages import ControllerStatus, DeviceStatus

HOLD, PROGRESS = "device/hold", "progress"
RECORDER, PARAMETERS_OF = "recorder", "parameters_of"
_CONTROLLER, _DEVICE = "needle/controller_status", "device/status"
HOLD_PERIOD = 0.05
"""Period of device/hold, which the device requires every 0.1 s [s]."""
# Number of final release messages, as delivery of the hold is best effort.
_RELEASES = 3


@dataclasses.dataclass(frozen=True)
class SimulatedOperatorParameters:
    """Parameters of simulated_operator."""

    wait_for_recorder: bool = fixed_parameter(
        False, "-", "Wait until the recorder has the parameters of all nodes."
    )

    def __post_init__(self) -> None:
        check_fields(self)


class SimulatedOperator(Component):
    """Component that executes an `OperatorSequence`.

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
        self._unrecorded: Sequence[str] = ("recorder",) if settings.wait_for_recorder else ()
        self._nodes: frozenset[str] = frozenset()
        self._sequence = OperatorSequence(now, self.name)
        self._session = HoldSession(name)
        self._pending: Call | None = None
        self._is_finished = False
        self._missing: list[str] = ["everything"]
        self.inputs = (
            Input(_CONTROLLER, ControllerStatus, self._on_controller, LATCHED),
            Input(_DEVICE, DeviceStatus, self._on_device, LATCHED),
        )
        if settings.wait_for_recorder:
            self.inputs += (Input("/diagnostics", m.Diagnostics, self._on_health),)
        self.outputs = (Output(HOLD, m.HoldState, BEST_EFFORT),)
        self.timers = (Timer(HOLD_PERIOD, self._on_timer),)

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Update the list of missing nodes and services."""
        self._sequence.handle_devices(peers.publishers.get(_DEVICE, ()))
        missing = [
            f"service {call.service}" for call in PREPARATION if call.service not in peers.services
        ]
        for topic in (_CONTROLLER, _DEVICE):
            if topic not in peers.publishers:
                missing.append(f"publisher of {topic}")
        if HOLD not in peers.subscribers:
            missing.append(f"subscriber of {HOLD}")
        self._missing, self._nodes = missing, peers.nodes
        self._sequence.handle_missing([*self._missing, *self._unrecorded])
        return ()

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        """Handle the answer to the last call; exit after the final call."""
        if self._is_finished:
            return self._exit() if answer.service == DISABLE.service else ()
        call = self._pending
        if call is None or call.service != answer.service or not answer.answered:
            return ()
        self._sequence.handle_answer(call, answer.success, answer.text, at.steady)
        return self._advance(at)

    def on_stop(self, at: Moment) -> Actions:
        """Release, disable, and exit as interrupted."""
        self._sequence.interrupt()
        outcome = self._sequence.outcome
        if self._is_finished and outcome is not None:
            # The signal also ends the other nodes, so they do not answer.
            return (Exit(EXIT_INTERRUPTED, outcome.text),)
        return self._advance(at)

    def _on_controller(self, message: ControllerStatus, at: Moment) -> Actions:
        self._sequence.handle_controller(message, at.steady)
        if self._sequence.steering:
            yield Send(PROGRESS, (message,))
        yield from self._advance(at)

    def _on_device(self, message: DeviceStatus, at: Moment) -> Actions:
        self._sequence.handle_device(message, at.steady)
        return self._advance(at)

    def _on_health(self, message: m.Diagnostics, at: Moment) -> Actions:
        """Update the nodes whose parameters are not in the bag yet; a rerun needs them."""
        for status in message.statuses:
            if status.part == PARAMETERS_OF and status.source.rpartition("/")[2] == RECORDER:
                recorded = {name.lstrip("/") for name in status.text.split(", ")}
                missing = sorted(self._nodes - recorded)
                self._unrecorded = [f"recorder of {name}'s parameters" for name in missing]
                self._sequence.handle_missing([*self._missing, *self._unrecorded])
        return ()

    def _on_timer(self, at: Moment) -> Actions:
        # Publish releases as well: the device accepts a press only after a release.
        if self._sequence.may_act and not self._is_finished:
            yield self._hold(at, pressed=self._sequence.hold())
        self._sequence.check_time(at.steady)
        yield from self._advance(at)

    def _advance(self, at: Moment) -> Actions:
        if self._is_finished:
            return
        if self._sequence.outcome is not None:
            yield from self._finish(at)
            return
        call = self._sequence.next_call(at.steady)
        if call is not None:
            self._pending = call
            yield call
        yield self._report()

    def _finish(self, at: Moment) -> Actions:
        self._is_finished = True
        if not self._sequence.touched:
            yield from self._exit()
            return
        for _ in range(_RELEASES):
            yield self._hold(at, pressed=False)
        yield self._report()
        yield DISABLE

    def _exit(self) -> Actions:
        assert self._sequence.outcome is not None
        yield self._sequence.outcome

    def _hold(self, at: Moment, *, pressed: bool) -> Publish:
        return Publish(HOLD, self._session.next_message(at.stamp_ns, pressed=pressed, speed=1.0))

    def _report(self) -> Diagnose:
        if self._sequence.steering:
            message = "the hold is pressed"
        elif self._sequence.outcome is not None:
            message = "the hold is released"
        else:
            message = "prepares the rig"
        return Diagnose("hold", Diagnostic(Level.OK, message))
