"""The `plane_controller` executable."""

from __future__ import annotations

import sys

from needle_controller.plane_controller import PlaneController
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.ros.main import run_component

HELP = """
plane_controller: steers the needle into the target plane or to the target point, with one insertion
step, or one new path if it inserts continuously, per measured tip.

Subscribes  needle/tip, needle/tip_pose (its covariance), target_plane, target_point, obstacles,
            needle/proposed_target, joint_states, device/result, device/status
Publishes   device/joint_trajectory, needle/estimate, needle/reduced_state, needle/linearized_state,
            needle/control_input, needle/planned_path (with obstacles or an own planner),
            needle/controller_status, target_point (a proposal that was accepted), /diagnostics
Services    ~/start, ~/stop, ~/accept_target
"""


def main() -> int:
    """Run the node; returns its exit code."""
    return run_component("plane_controller", SteeringSettings, PlaneController, help_text=HELP)


if __name__ == "__main__":
    sys.exit(main())
