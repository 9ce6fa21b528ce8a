"""An operator of a simulated device, and what it hears."""

import dataclasses

from needle_bringup.simulated_operator.operator_sequence import (
    PREPARATION,
    OperatorSequence,
    Outcome,
    ServiceCall,
)
from needle_core.status_messages import ControllerStatus, DeviceStatus

CONFIRM = PREPARATION[0]
DISABLED = {"homed": "true", "state": "DISABLED"}


def fresh() -> OperatorSequence:
    """Return a sequence before a simulated device that is alone."""
    sequence = OperatorSequence(0.0, "simulated_operator", wait_timeout=30.0, stall_timeout=60.0)
    sequence.see_devices(["/sim_rig"])
    see(sequence, {}, 0.0)
    sequence.see_controller(ControllerStatus(state="IDLE", starts=0), 0.0)
    return sequence


def see(sequence: OperatorSequence, values: dict[str, str], now: float) -> None:
    status = DeviceStatus.parse({"simulated": "true"} | values)
    sequence.see_device(dataclasses.replace(status, source="/sim_rig"), now)


def outcome(sequence: OperatorSequence) -> Outcome | None:
    """Return the outcome; a call, so that mypy does not take it for settled once it was None."""
    return sequence.outcome


def answer(sequence: OperatorSequence, message: str = "") -> None:
    """Let the next call be made and agreed to."""
    call = sequence.next_call(1.0)
    assert call is not None
    sequence.take_answer(call, True, message, 1.0)


def prepare(sequence: OperatorSequence, now: float = 1.0) -> list[ServiceCall]:
    sequence.see_missing([])
    see(sequence, {"homed": "true", "state": "DISABLED"}, 1.0)
    calls = []
    while (call := sequence.next_call(now)) is not None:
        calls.append(call)
        sequence.take_answer(call, True, "", now)
    return calls


def steering(**values: str) -> ControllerStatus:
    said = {"state": "STEERING", "step": "3", "insertion_m": "0.003", "depth_m": "0.12"}
    status: ControllerStatus = ControllerStatus.parse(said | {"starts": "1"} | values)
    return status


def reach(wanted: ServiceCall) -> OperatorSequence:
    """Return a sequence that has just made the call, for the first time, at 1.0 s."""
    sequence = fresh()
    sequence.see_missing([])
    see(sequence, DISABLED, 1.0)
    for _ in range(PREPARATION.index(wanted)):
        answer(sequence)
    assert sequence.next_call(1.0) == wanted
    return sequence
