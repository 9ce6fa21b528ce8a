"""Devices of the simulated rig: what moves the needle at each level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from needle_core import messages as m
from needle_core.component import Actions, Input, Moment, Output, Peers, Publish, Service
from needle_device_driver.device import EMERGENCY_STOP, DeviceInterface
from needle_device_driver.procedure import run_at_once
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.rig.bench import SimulatedBench
from needle_sim.rig.simulated_axis import SimulatedAxis

CYCLE = 0.02
"""Period of the axes' set-points [s]."""


class Device(Protocol):
    """A device that moves the bench.

    Attributes
    ----------
    inputs, outputs, services : sequences of rows
        What it adds to the rig's component.
    """

    inputs: Sequence[Input]
    outputs: Sequence[Output]
    services: Sequence[Service]

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note who else is a device here."""

    def move(self, at: Moment) -> Actions:
        """Let a cycle go by."""

    def report(self, at: Moment) -> Actions:
        """Tell what came of the cycle."""

    def fail(self, why: str) -> Actions:
        """Stop both axes for good."""


class IdealDevice:
    """Levels `tip` and `camera`: ideal axes behind the motion supervisor.

    Parameters
    ----------
    bench : SimulatedBench
        What is moved.
    name : str
        Name of the component.
    limits : SafetyLimits
        The supervisor's.
    """

    def __init__(self, bench: SimulatedBench, name: str, limits: SafetyLimits) -> None:
        self._bench = bench
        self._ended = ""
        self._axes = (SimulatedAxis("insertion"), SimulatedAxis("rotation"))
        self._supervisor = MotionSupervisor(*self._axes, limits)
        run_at_once(self._supervisor.configure(0.0))
        self._rows = DeviceInterface(
            self._supervisor, name, simulated=True, not_ready=lambda: self._ended
        )
        self.inputs: Sequence[Input] = self._rows.inputs
        self.outputs: Sequence[Output] = self._rows.outputs
        self.services: Sequence[Service] = self._rows.services

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note who else is a device here."""
        return self._rows.on_peers(peers, at)

    def move(self, at: Moment) -> Actions:
        """Move both axes to their set-points, and the needle with them."""
        self._supervisor.note_time(at.stamp_ns, at.steady)
        self._supervisor.drive(CYCLE, at.steady)
        for axis in self._axes:
            axis.advance(CYCLE)
        self._bench.move_to(*(axis.position for axis in self._axes))
        return ()

    def report(self, at: Moment) -> Actions:
        """Tell what came of the cycle."""
        self._supervisor.observe(at.steady)
        yield from self._rows.joint_states(at)
        yield from self._rows.report(at)

    def fail(self, why: str) -> Actions:
        """Stop both axes for good."""
        self._ended = why
        self._supervisor.fail(why)
        return ()


class DistantDevice:
    """Level `drive`: the motors of drive_emulator move the needle, and nobody's word does.

    Parameters
    ----------
    bench : SimulatedBench
        What is moved.
    """

    def __init__(self, bench: SimulatedBench) -> None:
        self._bench = bench
        self.inputs: Sequence[Input] = (
            Input("sim/drive_positions", m.JointState, self._on_positions),
        )
        self.outputs: Sequence[Output] = (Output(EMERGENCY_STOP, m.EmergencyStop),)
        self.services: Sequence[Service] = ()

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Do nothing: this is no device for others."""
        return ()

    def move(self, at: Moment) -> Actions:
        """Do nothing: the motors move by themselves."""
        return ()

    def report(self, at: Moment) -> Actions:
        """Do nothing: the driver reports."""
        return ()

    def fail(self, why: str) -> Actions:
        """Press the emergency stop."""
        yield Publish(EMERGENCY_STOP, m.EmergencyStop(pressed=True))

    def _on_positions(self, message: m.JointState, at: Moment) -> Actions:
        places = dict(zip(message.names, message.positions, strict=True))
        self._bench.move_to(places[m.INSERTION_JOINT], places[m.ROTATION_JOINT])
        return ()


def make_device(bench: SimulatedBench, name: str, *, level: str, limits: SafetyLimits) -> Device:
    """Return the device of a level."""
    return DistantDevice(bench) if level == "drive" else IdealDevice(bench, name, limits)
