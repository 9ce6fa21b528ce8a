"""Devices of the simulated rig: they move the needle at each level."""

from __future__ import annotations

from collections.abc import Sequence

from needle_core import messages as m
from needle_core.component import Actions, Input, Moment, Output, Peers, Publish, Service
from needle_device_driver.axes.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.device import EMERGENCY_STOP, DeviceInterface
from needle_device_driver.procedure import Procedure, run_at_once
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.bench import SimulatedBench

CYCLE = 0.02
"""Period of the axes' set-points [s]."""


class SimulatedAxis(Axis):
    """Ideal axis: it moves exactly at the commanded speed, in the time given by `advance`.

    Parameters
    ----------
    name : str
        Name of the axis in errors.
    position : float
        Initial position, relative to the home switch [m or rad].
    """

    def __init__(self, name: str, position: float = 0.0) -> None:
        self._name = name
        self._position = position
        self._target: float | None = None
        self._speed = 0.0
        self._velocity = 0.0
        self._powered = False
        self._homed = False
        self._homing = False
        self.fault = ""

    @property
    def position(self) -> float:
        """True position of the axis [m or rad]."""
        return self._position

    def configure(self) -> Procedure[None]:
        """Do nothing: an ideal axis needs no configuration."""
        yield from ()

    def power(self, on: bool) -> None:
        """Switch power on or off, and drop the target."""
        self.stop()
        self._powered = on

    def home(self, speed: float) -> Procedure[None]:
        """Move to position 0 at `speed`."""
        yield from ()
        self._require_power("home")
        self._homed = self._position == 0.0
        self._homing = not self._homed
        self._target, self._speed = 0.0, speed

    def start_move(self, target: float, speed: float) -> None:
        """Start a motion to `target` at `speed`."""
        self._require_power("move")
        self._target, self._speed = target, speed

    def stop(self) -> None:
        """Stop at once."""
        self._target = None
        self._velocity = 0.0
        self._homing = False

    def reset(self) -> Procedure[None]:
        """Clear the fault."""
        yield from ()
        self.fault = ""

    def poll(self, now: float) -> AxisSnapshot:
        """Return the state of the axis, always up to date."""
        return AxisSnapshot(
            time=now,
            position=self._position,
            set_point=self._position,
            velocity=self._velocity,
            powered=self._powered,
            homed=self._homed,
            moving=self._homing or self._target not in (None, self._position),
            at_home_switch=self._position <= 0.0,
            fault=self.fault,
        )

    def close(self) -> Procedure[None]:
        """Switch power off."""
        yield from ()
        self.power(False)

    def advance(self, period: float) -> None:
        """Advance the motion by `period` [s]."""
        if self._target is None or not self._powered or self.fault:
            self._velocity = 0.0
            return
        before = self._position
        distance = self._target - before
        step = self._speed * period
        # The tolerance prevents an extra period due to the rounding error of speed times period.
        if abs(distance) <= step * (1.0 + 1e-9):
            self._position = self._target
        else:
            self._position += step if distance > 0.0 else -step
        self._velocity = (self._position - before) / period
        if self._homing and self._position == 0.0:
            self._homing = False
            self._homed = True

    def _require_power(self, command: str) -> None:
        if not self._powered or self.fault:
            why = self.fault or "not powered"
            raise AxisError(f"{self._name} axis cannot {command}: {why}")


class IdealDevice:
    """Device of levels `tip` and `camera`: ideal axes behind the motion supervisor.

    Parameters
    ----------
    bench : SimulatedBench
        Needle that the axes move.
    name : str
        Name of the component.
    limits : SafetyLimits
        Limits of the motion supervisor.

    Attributes
    ----------
    inputs, outputs, services : sequences of rows
        Rows that the device adds to the rig's component.
    """

    def __init__(self, bench: SimulatedBench, name: str, limits: SafetyLimits) -> None:
        self._bench = bench
        self._failure = ""
        self._axes = (SimulatedAxis("insertion"), SimulatedAxis("rotation"))
        self._supervisor = MotionSupervisor(*self._axes, limits)
        run_at_once(self._supervisor.configure(0.0))
        self._rows = DeviceInterface(
            self._supervisor, name, simulated=True, not_ready=lambda: self._failure
        )
        self.inputs: Sequence[Input] = self._rows.inputs
        self.outputs: Sequence[Output] = self._rows.outputs
        self.services: Sequence[Service] = self._rows.services

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Check for other devices on the graph."""
        return self._rows.on_peers(peers, at)

    def move(self, at: Moment) -> None:
        """Advance both axes by one cycle, and the needle with them."""
        self._supervisor.note_time(at.stamp_ns, at.steady)
        self._supervisor.drive(CYCLE, at.steady)
        for axis in self._axes:
            axis.advance(CYCLE)
        self._bench.move_to(*(axis.position for axis in self._axes))

    def report(self, at: Moment) -> Actions:
        """Publish joint states and device status."""
        self._supervisor.observe(at.steady)
        yield from self._rows.joint_states(at)
        yield from self._rows.report(at)

    def fail(self, why: str) -> Actions:
        """Stop both axes permanently."""
        self._failure = why
        self._supervisor.fail(why)
        return ()


class MotorFollower:
    """Device of level `drive`: the needle follows the motors of drive_emulator.

    Parameters
    ----------
    bench : SimulatedBench
        Needle that the motors move.

    Attributes
    ----------
    inputs, outputs, services : sequences of rows
        Rows that the device adds to the rig's component.
    """

    def __init__(self, bench: SimulatedBench) -> None:
        self._bench = bench
        self.inputs: Sequence[Input] = (
            Input("sim/drive_positions", m.JointState, self._on_positions),
        )
        self.outputs: Sequence[Output] = (Output(EMERGENCY_STOP, m.EmergencyStop),)
        self.services: Sequence[Service] = ()

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Do nothing: the driver checks for other devices."""
        return ()

    def move(self, at: Moment) -> None:
        """Do nothing: the needle moves when motor positions arrive."""

    def report(self, at: Moment) -> Actions:
        """Do nothing: the driver reports."""
        return ()

    def fail(self, why: str) -> Actions:
        """Press the emergency stop."""
        yield Publish(EMERGENCY_STOP, m.EmergencyStop(pressed=True))

    def _on_positions(self, message: m.JointState, at: Moment) -> Actions:
        positions = dict(zip(message.names, message.positions, strict=True))
        self._bench.move_to(positions[m.INSERTION_JOINT], positions[m.ROTATION_JOINT])
        return ()
