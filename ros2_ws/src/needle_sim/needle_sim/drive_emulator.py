"""drive_emulator as a component: two CiA 402 drives behind a CAN port."""

from __future__ import annotations

from collections.abc import Sequence

from needle_core import messages as m
from needle_core.can_frame import CAN, CanFrame
from needle_core.component import (
    Actions,
    Component,
    Diagnose,
    Log,
    Moment,
    Output,
    Peers,
    Port,
    Publish,
    Send,
    Timer,
)
from needle_core.errors import UserError
from needle_sim.drive_emulator_parameters import DriveEmulatorParameters
from needle_sim.drives.cia402 import PowerState
from needle_sim.drives.emulated_bus import EmulatedBus, bus_health, obey

POSITIONS = "sim/drive_positions"
ADAPTER, COMMAND_LINES = "adapter", "command lines"
# How often the drives look at their clocks, and tell where their motors are [s].
_LOOK, _PERIOD = 0.005, 0.02


class DriveEmulator(Component):
    """Both drives with their motors, from the moment when their power comes.

    Parameters
    ----------
    settings : DriveEmulatorParameters
        The node's parameters.
    name : str
        Full name of the node.
    now : float
        Steady time at which the power comes [s].

    Attributes
    ----------
    bus : EmulatedBus
        The drives; faults are planted there.
    """

    name = "drive_emulator"

    def __init__(
        self, settings: DriveEmulatorParameters, name: str = name, now: float = 0.0
    ) -> None:
        self.name, self.settings = name, settings
        self.bus = EmulatedBus(settings.insertion, settings.rotation, now)
        self._states = dict.fromkeys(self.bus.drives, PowerState.NOT_READY)
        self._is_heard = False
        self.outputs = (Output(POSITIONS, m.JointState),)
        self.ports = (Port(CAN, self._on_frames), Port(COMMAND_LINES, self._on_commands))
        self.timers = (Timer(_LOOK, self._look), Timer(_PERIOD, self._tell_positions))

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note whether anybody wants to hear where the motors are."""
        self._is_heard = POSITIONS in peers.subscribers
        return ()

    def _on_frames(self, frames: Sequence[CanFrame], at: Moment) -> Actions:
        for frame in frames:
            self.bus.receive(frame, at.steady)
        return self._send(self.bus.take_sent())

    def _on_commands(self, lines: Sequence[str], at: Moment) -> Actions:
        """Carry out faults on command, and say where they came; complain about what is none."""
        for line in lines:
            axes = self.bus.axes(at.steady)
            try:
                order = obey(line, self.bus, at.steady)
            except UserError as error:
                yield Log("error", str(error))
                continue
            places = [axes[name].position for name in ("insertion", "rotation")]
            where = f"{places[0] * 1e3:.6f} mm, {places[1]:.6f} rad"
            yield Log("warning", f"on command: {line.strip()}, at {where}")
            if order is not None:
                yield Send(ADAPTER, (order,))
            yield Diagnose("drives", bus_health(self.bus))

    def _look(self, at: Moment) -> Actions:
        yield from self._send(self.bus.poll(at.steady))
        states = {name: drive.state for name, drive in self.bus.drives.items()}
        if states == self._states:
            return
        for name, state in states.items():
            if state is PowerState.FAULT and self._states[name] is not state:
                code = self.bus.drives[name].error_code
                yield Log("warning", f"{name} drive: fault 0x{code:04X}")
        self._states = states
        yield Diagnose("drives", bus_health(self.bus))

    def _send(self, frames: Sequence[CanFrame]) -> Actions:
        if frames:
            yield Send(CAN, tuple(frames))

    def _tell_positions(self, at: Moment) -> Actions:
        if not self._is_heard:
            return
        axes = self.bus.axes(at.steady)
        positions = tuple(axis.position for axis in axes.values())
        velocities = tuple(axis.velocity for axis in axes.values())
        names = tuple(f"{name}_joint" for name in axes)
        yield Publish(POSITIONS, m.JointState(at.stamp_ns, names, positions, velocities))
