"""Cameras and tracker of a trial: a needle is seen, wherever its drives are, and its tip told.

`python -m campaign.trials.computers.tip_camera --ros-args -p light:=FILE`
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

from geometry_msgs.msg import PointStamped

from campaign.trials.computers.light import Light
from needle_core.ros.base_node import STEADY_CLOCK, run_node
from needle_core.ros.conversions import RELIABLE, to_stamp
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_core.settings.parameter_fields import fixed_parameter
from needle_sim.rig.bench import SimulatedBench

_PERIOD = 1.0 / 30.0


@dataclasses.dataclass(frozen=True)
class TipCameraParameters:
    """Parameters of `tip_camera`."""

    light: str = fixed_parameter("", "", "File that says where the needle is.")
    clock_ahead: float = fixed_parameter(0.0, "s", "How far this computer's clock is ahead.")
    curvature: float = fixed_parameter(8.0, "1/m", "Of the needle's path.")


class TipCameraNode(WholeNode):
    """Tells a tip 30 times a second."""

    def __init__(self) -> None:
        super().__init__("stereo_tracker")
        values = NodeParameters(self, TipCameraParameters).values
        self._light = Light(Path(values.light))
        self._ahead_ns = round(values.clock_ahead * 1e9)
        self._bench = SimulatedBench(
            curvature=values.curvature,
            pitch=0.0,
            roll=0.0,
            torsion_play=0.0,
            torsion_lag=0.0,
            tip_noise=0.0,
            seed=0,
        )
        self._exposures = 0
        self._tips = self.create_publisher(PointStamped, "needle/tip", RELIABLE)
        self.create_timer(_PERIOD, self._expose, clock=STEADY_CLOCK)

    def _expose(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        self._bench.move_to(*self._light.joints)
        message = PointStamped()
        message.header.frame_id = "rig"
        message.header.stamp = to_stamp(now_ns + self._ahead_ns)
        point = message.point
        point.x, point.y, point.z = map(float, self._bench.measure_tip(self._exposures))
        self._exposures += 1
        self._tips.publish(message)


def main() -> int:
    """Run the node; returns its exit code."""
    return run_node(TipCameraNode, help_text=__doc__ or "", parameters=TipCameraParameters)


if __name__ == "__main__":
    sys.exit(main())
