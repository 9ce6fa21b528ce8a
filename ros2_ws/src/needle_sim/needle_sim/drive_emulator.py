"""drive_emulator as a component: the drives of both axes behind their ports, and its parameters."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from needle_core import messages as m
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
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_sim.drives.cia402 import SERVO, STEPPER, EmulatedDriveSettings
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_sim.drives.emulated_drives import FAULT, AxisState, EmulatedDrives
from needle_sim.drives.motor import MotorSettings

CIA402 = "cia402"
GROUP = "needle_sim.drives"
"""Group of the entry points, which are callables that return an `EmulatedDrives`."""
_OWN = {
    "galil": "needle_sim.drives.galil_drives:GalilDrives",
    "zaber": "needle_sim.drives.zaber_drives:ZaberDrives",
    "stepdir": "needle_sim.drives.stepdir_drives:StepdirDrives",
}
# Encoder of the rotation axis: 16 bits per turn, no gear.
COUNTS_PER_RADIAN = 65536.0 / (2.0 * math.pi)
# Lead of the insertion axis' screw: travel per turn of the motor [m].
_LEAD = 0.001
_LAST_NODE = 127


@dataclasses.dataclass(frozen=True)
class DriveEmulatorParameters:
    """Parameters of drive_emulator, fixed at the start."""

    drives: str = fixed_parameter(
        CIA402,
        "-",
        "Drives of both axes, or of insertion and rotation: cia402, galil, zaber, stepdir, or those"
        " of another package.",
    )
    listen: int = fixed_parameter(
        5023,
        "-",
        "TCP port of drives other than cia402; the second drives use the next one.",
        1,
        65534,
    )
    pty: str = fixed_parameter(
        "", "-", "Symbolic link to the pseudo-terminal; empty: only its own name is logged."
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
            If a parameter is out of bounds, a drive is unknown, or both have the same node id.
        """
        check_fields(self)
        if len(names := self.drives.split(",")) > len(AXES):
            raise UserError(f"drives = {self.drives!r} has {len(names)} names; at most {len(AXES)}")
        if self.insertion_node_id == self.rotation_node_id:
            raise UserError(f"both drives have node id {self.insertion_node_id}")
        if self.insertion_start > self.insertion_travel:
            raise UserError(
                f"insertion_start = {self.insertion_start:g} m is beyond insertion_travel = "
                f"{self.insertion_travel:g} m"
            )

    @property
    def axes_of(self) -> dict[str, tuple[str, ...]]:
        """Axes of each kind of drive."""
        names = self.drives.split(",")
        chosen = dict(zip(AXES, (names[0], names[-1]), strict=True))
        return {
            name: tuple(axis for axis in AXES if chosen[axis] == name) for name in chosen.values()
        }

    def motor(self, axis: str) -> MotorSettings:
        """Return the mechanics of an axis: insertion has a limit switch at either end."""
        scale, max_speed, lag = (
            getattr(self, f"{axis}_{name}") for name in ("counts_per_unit", "max_speed", "lag")
        )
        ends = (self.insertion_start, self.insertion_travel) if axis == "insertion" else ()
        return MotorSettings(scale, max_speed * scale, lag, *(end * scale for end in ends))

    def cia402(self, axis: str) -> EmulatedDriveSettings:
        """Return the CiA 402 drive of an axis: a stepper on a screw, or a servo."""
        device_type, turn = (STEPPER, _LEAD) if axis == "insertion" else (SERVO, 2.0 * math.pi)
        motor, node_id = self.motor(axis), getattr(self, f"{axis}_node_id")
        rpm = motor.counts_per_unit * turn / 60.0 if self.rpm else None
        return EmulatedDriveSettings(axis, node_id, device_type, motor, self.boot_time, rpm)


COMMANDS = """\
cut_bus             lose all data in both directions; the connection stays open
unplug              remove the CAN adapter, or close the TCP connections
stall AXIS          block the motor
reboot AXIS         interrupt the drive's power
emcy AXIS CODE      put the drive into a fault with this error code, such as 0x5530
hang AXIS           hang the drive's processor: it is silent, the motor ends at its set-point
restore             end cut_bus, unplug, stall and hang; AXIS is insertion or rotation"""
AXES = ("insertion", "rotation")
POSITIONS = "sim/drive_positions"
ADAPTERS, COMMAND_LINES = "adapters", "command lines"
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
    connections : dict of str to EmulatedDrives
        Drives behind each port; tests inject faults there.
    """

    name = "drive_emulator"

    def __init__(
        self, settings: DriveEmulatorParameters, name: str = name, now: float = 0.0
    ) -> None:
        self.name, self.settings = name, settings
        self.connections = {
            drives.port: drives for drives in map(partial(self._make, now), settings.axes_of)
        }
        self._states: dict[str, str] = {}
        self._has_subscriber = False
        self.outputs = (Output(POSITIONS, m.JointState),)
        self.ports = (
            *(Port(name, partial(self._on_input, name)) for name in self.connections),
            Port(COMMAND_LINES, self._on_commands),
        )
        self.timers = (
            Timer(_TIMER_PERIOD, self._poll),
            Timer(_POSITION_PERIOD, self._publish_positions),
        )

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note whether the motor positions have a subscriber."""
        self._has_subscriber = POSITIONS in peers.subscribers
        return ()

    @property
    def bus(self) -> EmulatedBus:
        """CAN bus with the CiA 402 drives."""
        return next(one for one in self.connections.values() if isinstance(one, EmulatedBus))

    def axes(self, now: float) -> dict[str, AxisState]:
        """Return the true states of both motors at steady time `now` [s]."""
        found: dict[str, AxisState] = {}
        for drives in self.connections.values():
            found |= drives.axes(now)
        return {axis: found[axis] for axis in AXES}

    def _make(self, now: float, name: str) -> EmulatedDrives:
        axes = self.settings.axes_of[name]
        if name == CIA402:
            return EmulatedBus(map(self.settings.cia402, axes), now)
        return _load_emulator(name)({axis: self.settings.motor(axis) for axis in axes}, now)

    def _on_input(self, port: str, batch: Sequence[Any], at: Moment) -> Actions:
        return self._send(port, self.connections[port].receive(batch, at.steady))

    def _on_commands(self, lines: Sequence[str], at: Moment) -> Actions:
        """Execute fault commands and log the motor positions; log invalid commands."""
        for line in lines:
            axes = self.axes(at.steady)
            try:
                plugged_in = self._execute(line, at.steady)
            except UserError as error:
                yield Log("error", str(error))
                continue
            insertion, rotation = (axes[name].position for name in AXES)
            where = f"{insertion * 1e3:.6f} mm, {rotation:.6f} rad"
            yield Log("warning", f"on command: {line.strip()}, at {where}")
            if plugged_in is not None:
                yield Send(ADAPTERS, (plugged_in,))
            yield Diagnose("drives", self._health())

    def _execute(self, line: str, now: float) -> bool | None:
        """Execute one of `COMMANDS`; return whether to plug the adapters in; None: no change."""
        drives_of = {axis: drives for drives in self.connections.values() for axis in drives.motors}
        match line.split():
            case ["cut_bus"]:
                for drives in drives_of.values():
                    drives.is_cut = True
            case ["unplug"]:
                return False
            case ["restore"]:
                for drives in self.connections.values():
                    drives.restore(now)
                return True
            case ["stall" | "hang" as fault, axis] if axis in drives_of:
                getattr(drives_of[axis], fault)(axis)
            case ["reboot", axis] if axis in drives_of:
                drives_of[axis].reboot(axis, now)
            case ["emcy", axis, text] if axis in drives_of and (code := _error_code(text)):
                drives_of[axis].fail(axis, code)
            case _:
                raise UserError(f"{line!r} is not a command; known:\n{COMMANDS}")
        return None

    def _health(self) -> Diagnostic:
        """Return the states of all drives, and the faults of drives and connections."""
        states = self._states_of_all()
        problems = [
            f"{drives.port} is cut" for drives in self.connections.values() if drives.is_cut
        ]
        if faults := [name for name, state in states.items() if state.startswith(FAULT)]:
            problems.insert(0, f"fault of {' and '.join(faults)}")
        level = Level.WARN if problems else Level.OK
        return Diagnostic(level, ", ".join(problems) or "runs", states)

    def _states_of_all(self) -> dict[str, str]:
        every = (drives.states() for drives in self.connections.values())
        return {axis: state for states in every for axis, state in states.items()}

    def _poll(self, at: Moment) -> Actions:
        for port, drives in self.connections.items():
            yield from self._send(port, drives.poll(at.steady))
        states = self._states_of_all()
        if states == self._states:
            return
        for name, state in states.items():
            if state.startswith(FAULT) and self._states.get(name) != state:
                yield Log("warning", f"{name} drive: {state.replace(FAULT, 'fault')}")
        self._states = states
        yield Diagnose("drives", self._health())

    def _send(self, port: str, batch: Sequence[Any]) -> Actions:
        if batch:
            yield Send(port, tuple(batch))

    def _publish_positions(self, at: Moment) -> Actions:
        if not self._has_subscriber:
            return
        axes = self.axes(at.steady)
        positions = tuple(axis.position for axis in axes.values())
        velocities = tuple(axis.velocity for axis in axes.values())
        names = tuple(f"{name}_joint" for name in axes)
        yield Publish(POSITIONS, m.JointState(at.stamp_ns, names, positions, velocities))


def _error_code(text: str) -> int:
    """Return a 16-bit error code; 0 for any other text."""
    with contextlib.suppress(ValueError):
        code = int(text, 0)
        return code if 1 <= code <= 0xFFFF else 0
    return 0


def _load_emulator(name: str) -> Callable[[Mapping[str, MotorSettings], float], EmulatedDrives]:
    """Return the factory for the drives of a name, from this package or another one.

    Its arguments are the motors of the axes, and the time of power-up [s].
    """
    own = (EntryPoint(known, place, GROUP) for known, place in _OWN.items())
    found = {entry.name: entry for entry in (*own, *entry_points(group=GROUP))}
    if name not in found:
        raise UserError(f"drives: {name!r} is unknown; known: {', '.join((CIA402, *found))}")
    loaded: Callable[[Mapping[str, MotorSettings], float], EmulatedDrives] = found[name].load()
    return loaded
