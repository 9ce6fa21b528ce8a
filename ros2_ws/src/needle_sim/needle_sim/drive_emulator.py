"""drive_emulator as a component: two CiA 402 drives behind a CAN port, and its parameters."""

from __future__ import annotations

import dataclasses
import math
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
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_sim.drives.cia402 import SERVO, STEPPER, PowerState
from needle_sim.drives.drive_motion import LimitAction
from needle_sim.drives.emulated_bus import EmulatedBus, bus_health, execute_command
from needle_sim.drives.emulated_drive import EmulatedDriveSettings
from needle_sim.drives.motor import MotorSettings

# Encoder of the rotation axis: 16 bits per turn, no gear.
COUNTS_PER_RADIAN = 65536.0 / (2.0 * math.pi)
# Lead of the insertion axis' screw: travel per turn of the motor [m].
_LEAD = 0.001
_LAST_NODE = 127


@dataclasses.dataclass(frozen=True)
class DriveEmulatorParameters:
    """Parameters of drive_emulator, fixed at the start."""

    pty: str = fixed_parameter(
        "", "-", "Symbolic link to the pseudo-terminal; empty: only its own name is logged."
    )
    limit_action: str = fixed_parameter(
        LimitAction.CLAMP.value,
        "-",
        "Reaction of a homed drive to a target beyond its software limits (0x607D).",
        choices=tuple(action.value for action in LimitAction),
    )
    rpm: bool = fixed_parameter(
        False, "-", "Both drives use rpm for speeds and rpm/s for ramps, and report it (0x60A9)."
    )
    boot_time: float = fixed_parameter(0.5, "s", "From power-up to the boot-up message.", 0.0, 60.0)
    insertion_node_id: int = fixed_parameter(
        1, "-", "CANopen node id of the stepper drive.", 1, _LAST_NODE
    )
    insertion_counts_per_unit: float = fixed_parameter(
        2.0e7, "1/m", "Position counts per metre of the insertion axis.", 1.0, 1e12
    )
    insertion_max_speed: float = fixed_parameter(
        0.01, "m/s", "Maximum speed of the insertion motor.", 1e-6, 1.0
    )
    insertion_lag: float = fixed_parameter(
        0.0, "s", "Time constant of the insertion motor.", 0.0, 1.0
    )
    insertion_start: float = fixed_parameter(
        0.0, "m", "Position of the insertion axis at power-up, from its home switch.", -0.003, 1.0
    )
    insertion_travel: float = fixed_parameter(
        0.25, "m", "Distance from the home switch to the other limit switch.", 0.001, 2.0
    )
    rotation_node_id: int = fixed_parameter(
        2, "-", "CANopen node id of the servo drive.", 1, _LAST_NODE
    )
    rotation_counts_per_unit: float = fixed_parameter(
        COUNTS_PER_RADIAN, "1/rad", "Position counts per radian of the rotation axis.", 1.0, 1e12
    )
    rotation_max_speed: float = fixed_parameter(
        20.0, "rad/s", "Maximum speed of the rotation motor.", 1e-3, 1e4
    )
    rotation_lag: float = fixed_parameter(
        0.005, "s", "Time constant of the rotation motor.", 0.0, 1.0
    )

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises
        ------
        UserError
            If a parameter is out of bounds, or both drives have the same node id.
        """
        check_fields(self)
        if self.insertion_node_id == self.rotation_node_id:
            raise UserError(f"both drives have node id {self.insertion_node_id}")
        if self.insertion_start > self.insertion_travel:
            raise UserError(
                f"insertion_start = {self.insertion_start:g} m is beyond insertion_travel = "
                f"{self.insertion_travel:g} m"
            )

    @property
    def insertion(self) -> EmulatedDriveSettings:
        """Insertion axis: a stepper on a screw, with a limit switch at either end."""
        scale = self.insertion_counts_per_unit
        ends = {"start": self.insertion_start * scale, "travel": self.insertion_travel * scale}
        return self._drive("insertion", STEPPER, _LEAD, **ends)

    @property
    def rotation(self) -> EmulatedDriveSettings:
        """Rotation axis: a servo with unlimited travel."""
        return self._drive("rotation", SERVO, 2.0 * math.pi)

    def _drive(
        self, axis: str, device_type: int, turn: float, **ends: float
    ) -> EmulatedDriveSettings:
        scale, node_id, max_speed, lag = (
            getattr(self, f"{axis}_{name}")
            for name in ("counts_per_unit", "node_id", "max_speed", "lag")
        )
        motor = MotorSettings(scale, max_speed * scale, lag, **ends)
        action = LimitAction(self.limit_action)
        rpm = scale * turn / 60.0 if self.rpm else None
        return EmulatedDriveSettings(axis, node_id, device_type, motor, action, self.boot_time, rpm)


POSITIONS = "sim/drive_positions"
ADAPTER, COMMAND_LINES = "adapter", "command lines"
# Periods of the drives' timers, and of the motor positions [s].
_TIMER_PERIOD, _POSITION_PERIOD = 0.005, 0.02


class DriveEmulator(Component):
    """Both drives with their motors, from power-up on.

    Parameters
    ----------
    settings : DriveEmulatorParameters
        Parameters of the node.
    name : str
        Full name of the node.
    now : float
        Steady time of power-up [s].

    Attributes
    ----------
    bus : EmulatedBus
        Bus with the drives; tests inject faults there.
    """

    name = "drive_emulator"

    def __init__(
        self, settings: DriveEmulatorParameters, name: str = name, now: float = 0.0
    ) -> None:
        self.name, self.settings = name, settings
        self.bus = EmulatedBus(settings.insertion, settings.rotation, now)
        self._states = dict.fromkeys(self.bus.drives, PowerState.NOT_READY)
        self._has_subscriber = False
        self.outputs = (Output(POSITIONS, m.JointState),)
        self.ports = (Port(CAN, self._on_frames), Port(COMMAND_LINES, self._on_commands))
        self.timers = (
            Timer(_TIMER_PERIOD, self._poll),
            Timer(_POSITION_PERIOD, self._publish_positions),
        )

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note whether the motor positions have a subscriber."""
        self._has_subscriber = POSITIONS in peers.subscribers
        return ()

    def _on_frames(self, frames: Sequence[CanFrame], at: Moment) -> Actions:
        for frame in frames:
            self.bus.receive(frame, at.steady)
        return self._send(self.bus.drain_outboxes())

    def _on_commands(self, lines: Sequence[str], at: Moment) -> Actions:
        """Execute fault commands and log the motor positions; log invalid commands."""
        for line in lines:
            axes = self.bus.axes(at.steady)
            try:
                adapter_command = execute_command(line, self.bus, at.steady)
            except UserError as error:
                yield Log("error", str(error))
                continue
            insertion, rotation = (axes[name].position for name in ("insertion", "rotation"))
            where = f"{insertion * 1e3:.6f} mm, {rotation:.6f} rad"
            yield Log("warning", f"on command: {line.strip()}, at {where}")
            if adapter_command is not None:
                yield Send(ADAPTER, (adapter_command,))
            yield Diagnose("drives", bus_health(self.bus))

    def _poll(self, at: Moment) -> Actions:
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

    def _publish_positions(self, at: Moment) -> Actions:
        if not self._has_subscriber:
            return
        axes = self.bus.axes(at.steady)
        positions = tuple(axis.position for axis in axes.values())
        velocities = tuple(axis.velocity for axis in axes.values())
        names = tuple(f"{name}_joint" for name in axes)
        yield Publish(POSITIONS, m.JointState(at.stamp_ns, names, positions, velocities))
