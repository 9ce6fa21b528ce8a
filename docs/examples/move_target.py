"""Moves the target in mid-run: when the needle is 40 mm in, it is to go 6 mm farther aside."""

import contextlib

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

AT, TARGET = 0.04, (0.003, -0.026, 0.1)  # insertion [m]; x, y, z in rig [m]


class MoveTarget(Node):
    """Receives the insertion depth, and publishes one target_point."""

    def __init__(self):
        super().__init__("move_target")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.target = self.create_publisher(PointStamped, "target_point", latched)
        self.create_subscription(JointState, "joint_states", self.on_joints, 10)
        self.moved = False

    def on_joints(self, joints):
        """Move the target, once."""
        insertion = joints.position[joints.name.index("insertion_joint")]
        if insertion >= AT and not self.moved:
            self.moved = True
            # Without a stamp it rests there.
            point = PointStamped()
            point.header.frame_id = "rig"
            point.point.x, point.point.y, point.point.z = TARGET
            self.target.publish(point)
            self.get_logger().info(f"at {insertion * 1e3:.1f} mm the target moves to {TARGET} m")


rclpy.init()
executor = SingleThreadedExecutor()
executor.add_node(MoveTarget())
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    # rclpy wakes its wait before it shuts down: one without a limit may miss that it is to end.
    while rclpy.ok():
        executor.spin_once(timeout_sec=0.5)
