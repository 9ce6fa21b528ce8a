"""Asks a running plane_controller for what it must refuse, and prints what it answered.

One JSON object: for each case whether it was refused, the reason, and whether the node's parameters
and target plane stayed as they were.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import GetParameters, ListParameters, SetParametersAtomically
from rclpy.parameter import Parameter

from needle_core.errors import UserError
from needle_core.ros.conversions import LATCHED, RELIABLE, values_of
from needle_verification.ros.listening_node import PATIENCE, ListeningNode

Answer = dict[str, Any]

CASES: dict[str, dict[str, Any]] = {
    "curvature 0": {"curvature": 0.0},
    "curvature negative": {"curvature": -8.0},
    "curvature not a number": {"curvature": math.nan},
    "state_weights not finite": {"state_weights": [1.0e6, math.inf, 0.0]},
    "state_weights negative": {"state_weights": [1.0e6, -1.0, 0.0]},
    "state_weights of nine numbers": {"state_weights": [float(k) for k in range(9)]},
    "input_weight 0": {"input_weight": 0.0},
    "process_noise without a gain": {"process_noise": [0.0, 0.0, 0.0]},
    "target_offset out of reach": {"target_offset": 0.09},
    "depth too small for its flips": {"depth": 0.02, "flip_depths": [0.05]},
    "flips with preset paper": {"preset": "paper", "flip_depths": [0.05]},
    "one bad value among good ones": {"tip_margin": 0.005, "preset": "best_of_all"},
}
"""Values that each case sets; every one must be refused as a whole."""
FAR_PLANE = 0.09


class BadParameters(ListeningNode):
    """Speaks to `plane_controller` in its own domain."""

    def __init__(self) -> None:
        super().__init__("bad_parameters")
        self._offset = ""
        self._complaint = ""
        self._planes = self.create_publisher(PoseStamped, "target_plane", LATCHED)
        self.create_subscription(
            DiagnosticStatus, "needle/controller_status", self._on_status, LATCHED
        )
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RELIABLE)
        self._set = self.create_client(
            SetParametersAtomically, "plane_controller/set_parameters_atomically"
        )
        self._get = self.create_client(GetParameters, "plane_controller/get_parameters")
        self._list = self.create_client(ListParameters, "plane_controller/list_parameters")
        for client in (self._set, self._get, self._list):
            if not client.wait_for_service(timeout_sec=PATIENCE):
                raise UserError("plane_controller does not answer")
        self.until(lambda: self._offset != "", "needle/controller_status")

    def answers(self) -> dict[str, Answer]:
        """Try every case."""
        found = {case: self._try(values) for case, values in CASES.items()}
        found["target_plane out of reach"] = self._try_plane()
        return found

    def _try(self, values: dict[str, Any]) -> Answer:
        before = self._values()
        request = SetParametersAtomically.Request(
            parameters=[Parameter(name, value=v).to_parameter_msg() for name, v in values.items()]
        )
        result = self.answer_to(self._set, request).result
        return {
            "refused": not result.successful,
            "reason": result.reason,
            "kept": self._values() == before,
        }

    def _try_plane(self) -> Answer:
        before = self._offset
        plane = PoseStamped()
        plane.header.frame_id = "rig"
        plane.pose.position.x = FAR_PLANE
        plane.pose.orientation.w = 1.0
        self._planes.publish(plane)
        self.until(lambda: self._complaint != "", "a word on target_plane in /diagnostics")
        return {"refused": True, "reason": self._complaint, "kept": self._offset == before}

    def _values(self) -> str:
        names = self.answer_to(self._list, ListParameters.Request()).result.names
        values = self.answer_to(self._get, GetParameters.Request(names=names)).values
        return str(list(zip(names, values, strict=True)))

    def _on_status(self, message: DiagnosticStatus) -> None:
        self._offset = values_of(message).get("target_offset_m", "")

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "plane_controller: target_plane" and status.message != "ok":
                self._complaint = status.message


def main() -> int:
    """Try every case and print the answers; returns the exit code."""
    rclpy.init()
    try:
        node = BadParameters()
        print(json.dumps(node.answers()))
        node.close()
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
