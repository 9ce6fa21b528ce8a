"""A controller that uses only topics: receives tips, publishes steps, needs no needle_controller.

It replaces plane_controller: sim_rig publishes the tips, and simulated_operator starts it. A line
through the last tips gives the heading of the needle; the bevel is turned up or down in proportion
to the heading error. All is SI; x is up, z ahead.
"""

import contextlib

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PointStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

PLANE, DEPTH, STEP, SPEED = 0.003, 0.12, 0.001, 0.002  # x of the plane; a step and its speed
LOOK_BACK, LEVEL_OUT, GAIN = 0.02, 0.04, 10.0  # length of tips in the fit; distance to aim at
MOST_TURN, JOINTS = (
    0.5,
    ["insertion_joint", "rotation_joint"],
)  # largest rotation of the base in a step
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class TopicController(Node):
    """Answers every tip with the next step, until the depth is reached."""

    def __init__(self):
        super().__init__("plane_controller")
        self.starts, self.joints, self.tips = 0, [0.0, 0.0], []
        self.seen = self.after = 0  # stamps of the newest tip and of the last motion
        self.commands = self.create_publisher(JointTrajectory, "device/joint_trajectory", 10)
        self.status = self.create_publisher(DiagnosticStatus, "needle/controller_status", LATCHED)
        self.create_subscription(JointState, "joint_states", self.on_joints, 10)
        self.create_subscription(PointStamped, "needle/tip", self.on_tip, 10)
        self.create_subscription(Header, "device/result", self.on_result, 10)
        self.create_subscription(DiagnosticStatus, "device/status", self.on_device, LATCHED)
        self.create_service(Trigger, "~/start", self.start)
        self.publish_status("IDLE", "nothing")

    def publish_status(self, state, awaiting):
        """Publish the state, the insertion depth and whether a tip is awaited."""
        self.awaiting = awaiting
        keys = {"state": state, "awaiting": awaiting, "tip_after_ns": self.after, "depth_m": DEPTH}
        keys |= {"starts": self.starts, "step": len(self.tips), "insertion_m": self.joints[0]}
        values = [KeyValue(key=key, value=str(value)) for key, value in keys.items()]
        self.status.publish(DiagnosticStatus(name="plane_controller: steering", values=values))

    def start(self, _, answer):
        """Begin: as soon as the hold is pressed, the next tip leads to the first step."""
        self.starts, self.tips, answer.success = self.starts + 1, [], True
        self.publish_status("STEERING", "hold")
        return answer

    def on_device(self, device):
        """Continue when the hold is pressed; without it the device executes no step."""
        held = any(pair.key == "hold_owner" and pair.value for pair in device.values)
        if held and self.awaiting == "hold":
            self.publish_status("STEERING", "tip")

    def on_joints(self, joints):
        """Keep how far the needle's base is in and turned."""
        self.joints = [joints.position[joints.name.index(joint)] for joint in JOINTS]

    def on_tip(self, tip):
        """Turn the bevel by how far the needle is from its way, and go on by a step."""
        self.seen = tip.header.stamp.sec * 10**9 + tip.header.stamp.nanosec
        if self.awaiting != "tip" or self.seen <= self.after:
            return
        self.tips.append((tip.point.x - PLANE, tip.point.z))
        x, z = np.array([t for t in self.tips if t[1] >= tip.point.z - LOOK_BACK]).T
        slope, height = np.polyfit(z, x, 1) if len(z) > 3 else (0.0, x[-1])
        self.above = slope * z[-1] + height
        # Roll +90 deg bends up, -90 deg down; in between it bends less.
        roll = np.clip(GAIN * (-self.above / LEVEL_OUT - slope), -1.0, 1.0) * np.pi / 2.0
        turn = float(np.clip(roll - self.joints[1], -MOST_TURN, MOST_TURN))
        self.aim = min(self.joints[0] + STEP, DEPTH)
        point = JointTrajectoryPoint(positions=[self.aim, self.joints[1] + turn])
        point.time_from_start.nanosec = int(STEP / SPEED * 1e9)
        self.awaiting = "result"
        step = JointTrajectory(header=tip.header, joint_names=JOINTS, points=[point])
        self.commands.publish(step)

    def on_result(self, result):
        """Ask for the next tip once the step is done, or for the hold that has ended it."""
        if self.awaiting != "result":
            return
        self.after = self.seen  # a tip of before the answer may be one of before the step's end
        if result.frame_id != "succeeded":
            self.publish_status("STEERING", "hold")
        elif self.aim < DEPTH:
            self.publish_status("STEERING", "tip")
        else:
            self.get_logger().info(f"done, {self.above * 1e3:.2f} mm above the plane")
            self.publish_status("DONE", "nothing")


rclpy.init()
executor = SingleThreadedExecutor()
executor.add_node(TopicController())
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    # rclpy wakes its wait before it shuts down: one without a limit may miss that it is to end.
    while rclpy.ok():
        executor.spin_once(timeout_sec=0.5)
