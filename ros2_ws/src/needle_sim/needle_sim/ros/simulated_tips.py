"""Exposures of sim_rig at level tip: the measured tip."""

from __future__ import annotations

import math
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from needle_core.ros.conversions import RELIABLE
from needle_sim.rig.bench import SimulatedBench
from needle_sim.ros.conversions import to_tip, to_tip_pose
from needle_sim.sim_rig_parameters import SimRigParameters


class SimulatedTips:
    """Publishes the tip with the noise of each exposure.

    Parameters
    ----------
    node : Node
        Gets the publishers.
    bench : SimulatedBench
        What is measured.
    values : SimRigParameters
        The node's.

    Attributes
    ----------
    publishers, heard : list of Publisher
        All of its publishers, and those that partners must listen to.
    subscriptions : list of Subscription
        Topics that partners must publish.
    """

    half_sizes = (math.inf, math.inf)
    """Ends of the phantom, either way, along x and y [m]: none without cameras."""

    def __init__(self, node: Node, bench: SimulatedBench, values: SimRigParameters) -> None:
        self._bench = bench
        self._noise = values.tip_noise
        self._tip = node.create_publisher(PointStamped, "needle/tip", RELIABLE)
        self._tip_pose = node.create_publisher(
            PoseWithCovarianceStamped, "needle/tip_pose", RELIABLE
        )
        self.publishers: list[Publisher[Any]] = [self._tip, self._tip_pose]
        self.heard: list[Publisher[Any]] = [self._tip]
        self.subscriptions: list[Subscription[Any]] = []

    def expose(self, number: int, stamp: Time) -> None:
        """Publish the measurement of an exposure."""
        tip = self._bench.measure_tip(number)
        self._tip_pose.publish(to_tip_pose(tip, self._noise, stamp))
        self._tip.publish(to_tip(tip, stamp))

    def close(self) -> None:
        """Do nothing: nothing is open."""
