"""sim_rig as a component: stands in for the rig behind the same topics and services."""

from __future__ import annotations

from needle_common import messages as m
from needle_common.component import (
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
from needle_common.diagnostics import Diagnostic, Level
from needle_common.rotations import quaternion_from_rotation
from needle_device_driver.device import DeviceRows
from needle_device_driver.supervisor.supervisor import MotionSupervisor
from needle_sim.rig.bench import SimulatedBench
from needle_sim.rig.simulated_axis import SimulatedAxis
from needle_sim.sim_rig_parameters import SimRigParameters

CYCLE = 0.02
"""Period of the axes' set-points [s]."""
RIG = "rig"
_IDLE_EXPOSURE_PERIOD = 1.0
"""A needle that nobody waits for is exposed so often [s]."""
# A tip alone says nothing about the heading [rad^2].
_UNKNOWN_ORIENTATION = 1e6
# A variance of 0 would read as "not known" [m^2].
_LEAST_POSITION_VARIANCE = 1e-12
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class SimRig(Component):
    """The simulated rig of level `tip`: ideal axes, the plant they move, and a noisy tip.

    Parameters
    ----------
    settings : SimRigParameters
        The node's parameters.
    """

    name = "sim_rig"

    def __init__(self, settings: SimRigParameters) -> None:
        self.settings = settings
        self._bench = SimulatedBench(
            curvature=settings.curvature,
            pitch=settings.initial_pitch,
            roll=settings.initial_roll,
            torsion_play=settings.torsion_play,
            torsion_lag=settings.torsion_lag,
            tip_noise=settings.tip_noise,
            seed=settings.seed,
        )
        self._axes = (SimulatedAxis("insertion"), SimulatedAxis("rotation"))
        self._supervisor = MotionSupervisor(*self._axes, settings.limits)
        self._supervisor.configure(0.0)
        self._device = DeviceRows(self._supervisor, self.name, simulated=True)
        self._is_tip_wanted = False
        self._exposures = 0
        self._exposed_at = 0.0
        status = Input("needle/controller_status", m.Status, self._on_controller, LATCHED)
        self.inputs = (*self._device.inputs, status)
        self.outputs = (
            *self._device.outputs,
            Output("sim/tip_pose", m.Pose),
            Output("needle/tip_pose", m.PoseWithCovariance),
            Output("needle/tip", m.Point),
        )
        self.services = self._device.services
        self.timers = (
            Timer(CYCLE, self._cycle),
            Timer(1.0 / settings.camera_rate, self._expose_if_due),
        )

    def on_peers(self, peers: Peers, at: Moment) -> Actions:
        """Note who else is a device here."""
        return self._device.on_peers(peers, at)

    def _on_controller(self, message: m.Status, at: Moment) -> Actions:
        values = message.values
        is_continuous = values.get("insertion") == "continuous"
        is_steered = values.get("state") in ("STEERING", "WAITING_FOR_TIP")
        self._is_tip_wanted = values.get("awaiting") == "tip" or (is_continuous and is_steered)
        return ()

    def _cycle(self, at: Moment) -> Actions:
        self._supervisor.note_time(at.stamp_ns, at.steady)
        self._supervisor.drive(CYCLE, at.steady)
        for axis in self._axes:
            axis.advance(CYCLE)
        self._bench.move_to(*(axis.position for axis in self._axes))
        self._supervisor.observe(at.steady)
        yield from self._device.joint_states(at)
        yield from self._device.report(at)

    def _expose_if_due(self, at: Moment) -> Actions:
        if self._is_tip_wanted or at.steady - self._exposed_at >= _IDLE_EXPOSURE_PERIOD:
            yield from self._expose(at)

    def _expose(self, at: Moment) -> Actions:
        tip = self._bench.measure_tip(self._exposures)
        self._exposures += 1
        self._exposed_at = at.steady
        position = (float(tip[0]), float(tip[1]), float(tip[2]))
        yield Publish("sim/tip_pose", self._truth(at.stamp_ns))
        yield Publish("needle/tip_pose", self._tip_pose(position, at.stamp_ns))
        yield Publish("needle/tip", m.Point(at.stamp_ns, RIG, position))
        values = {"exposures": str(self._exposures), "simulated_s": f"{at.steady:.2f}"}
        yield Diagnose("simulation", Diagnostic(Level.OK, "running", values))

    def _truth(self, stamp_ns: int) -> m.Pose:
        T_rig_tip = self._bench.plant.T_rig_tip  # noqa: N806
        x, y, z = (float(c) for c in T_rig_tip[:3, 3])
        orientation = quaternion_from_rotation(T_rig_tip[:3, :3].tolist())
        return m.Pose(stamp_ns, RIG, (x, y, z), orientation)

    def _tip_pose(self, position: m.Vector3, stamp_ns: int) -> m.PoseWithCovariance:
        """Return a measured tip with uniform noise and no known orientation."""
        variance = max(self.settings.tip_noise**2 / 3.0, _LEAST_POSITION_VARIANCE)
        covariance = [0.0] * 36
        covariance[::7] = [variance] * 3 + [_UNKNOWN_ORIENTATION] * 3
        return m.PoseWithCovariance(stamp_ns, RIG, position, _UPRIGHT, tuple(covariance))
