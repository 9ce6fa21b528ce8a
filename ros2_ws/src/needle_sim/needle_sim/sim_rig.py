"""sim_rig as a component: simulates the rig behind the topics and services of the real one."""

from __future__ import annotations

import math
from collections.abc import Callable

from needle_core import messages as m
from needle_core.component import (
    LATCHED,
    Actions,
    Component,
    Diagnose,
    Input,
    Moment,
    Output,
    Peers,
    Publish,
    Timer,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.rotations import quaternion_from_rotation
from needle_core.status_messages import ControllerStatus
from needle_sim.bench import SimulatedBench
from needle_sim.devices import CYCLE, IdealDevice, MotorFollower
from needle_sim.sensors import RIG, Sensor, make_sensor
from needle_sim.sim_rig_parameters import SimRigParameters

_IDLE_EXPOSURE_PERIOD = 1.0
"""Time between exposures while the controller does not wait for a tip [s]."""


class SimRig(Component):
    """Simulated rig: the needle, a device that moves it, and a sensor that measures it.

    Parameters
    ----------
    settings : SimRigParameters
        Parameters of the node.
    name : str
        Full name of the node.
    new_sensor : callable
        Returns the sensor for a bench and settings.
    now : float
        Steady time [s].
    """

    name = "sim_rig"

    def __init__(
        self,
        settings: SimRigParameters,
        name: str = name,
        new_sensor: Callable[[SimulatedBench, SimRigParameters], Sensor] = make_sensor,
        now: float = 0.0,
    ) -> None:
        self.name, self.settings = name, settings
        self._bench = SimulatedBench(settings)
        self._device: IdealDevice | MotorFollower
        if settings.level == "drive":
            self._device = MotorFollower(self._bench)
        else:
            self._device = IdealDevice(self._bench, name, settings.limits)
        self._sensor = new_sensor(self._bench, settings)
        self._failure = ""
        self._is_tip_awaited = False
        self._exposures = 0
        self._exposed_at = self._started_at = now
        status = Input("needle/controller_status", ControllerStatus, self._on_controller, LATCHED)
        self.inputs = (*self._device.inputs, status)
        self.outputs = (
            *self._device.outputs,
            Output("sim/tip_pose", m.Pose),
            *self._sensor.outputs,
        )
        self.services, self.ports = self._device.services, self._sensor.ports
        self.timers = (
            Timer(CYCLE, self._cycle),
            Timer(1.0 / settings.camera_rate, self._expose_if_due),
        )

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Check for other devices on the graph."""
        return self._device.on_peers(peers, at)

    def _on_controller(self, message: ControllerStatus, at: Moment) -> Actions:
        is_continuous = message.insertion == "continuous"
        self._is_tip_awaited = message.awaiting == "tip" or (is_continuous and message.is_steering)
        return ()

    def _cycle(self, at: Moment) -> Actions:
        self._device.move(at)
        yield from self._fail_outside_phantom()
        yield from self._device.report(at)

    def _expose_if_due(self, at: Moment) -> Actions:
        if self._failure:
            return
        if self._is_tip_awaited or at.steady - self._exposed_at >= _IDLE_EXPOSURE_PERIOD:
            yield from self._expose(at)

    def _expose(self, at: Moment) -> Actions:
        number = self._exposures
        self._exposures += 1
        self._exposed_at = at.steady
        yield Publish("sim/tip_pose", self._true_pose(at.stamp_ns))
        yield from self._sensor.expose(number, at.stamp_ns)
        values = {
            "exposures": str(self._exposures),
            "simulated_s": f"{at.steady - self._started_at:.2f}",
        }
        yield Diagnose("simulation", Diagnostic(Level.OK, "running", values))

    def _true_pose(self, stamp_ns: int) -> m.Pose:
        T_rig_tip = self._bench.plant.T_rig_tip  # noqa: N806
        x, y, z = (float(c) for c in T_rig_tip[:3, 3])
        orientation = quaternion_from_rotation(T_rig_tip[:3, :3].tolist())
        return m.Pose(stamp_ns, RIG, (x, y, z), orientation)

    def _fail_outside_phantom(self) -> Actions:
        for axis, place, end in zip("xy", self._bench.tip, self._sensor.half_sizes, strict=False):
            if abs(place) > end and not self._failure:
                self._failure = (
                    f"the tip left the phantom: {axis} = {place * 1e3:.2f} mm is beyond "
                    f"{math.copysign(end, place) * 1e3:.2f} mm"
                )
                yield from self._device.fail(self._failure)
                yield Diagnose("simulation", Diagnostic(Level.ERROR, self._failure))
