"""Health of the emulated drives, as a diagnostic."""

from __future__ import annotations

from needle_core.diagnostics import Diagnostic, Level
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_sim.drives.power_state import PowerState


def bus_health(bus: EmulatedBus) -> Diagnostic:
    """Return the states of both drives, and what is the matter with them or their bus."""
    states = {name: drive.state.name for name, drive in bus.drives.items()}
    faults = [name for name, state in states.items() if state == PowerState.FAULT.name]
    message = f"fault of {' and '.join(faults)}" if faults else "runs"
    if bus.is_cut:
        message += ", the bus is cut"
    level = Level.WARN if faults or bus.is_cut else Level.OK
    return Diagnostic(level, message, states)
