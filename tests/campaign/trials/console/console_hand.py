"""Controller and witness of a console's trial: it sends steps all the time, whoever holds."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from sensor_msgs.msg import JointState

from campaign.trials.drives.drive_hand import JOINTS, DriveHand
from needle_core.ros.base_node import STEADY_CLOCK
from needle_core.ros.conversions import JOINT_STATES, LATCHED, RELIABLE

SPEED = 0.005
"""Of each step [m/s]."""

_STEP = 0.002
_PERIOD = 0.02
_AGAIN = 0.1


@dataclasses.dataclass(frozen=True)
class Moved:
    """A joint_states that tells of motion.

    Attributes
    ----------
    sent_ns : int
        When it was sent, system clock [ns].
    insertion : float
        Where the axis is then [m].
    """

    sent_ns: int
    insertion: float


class ConsoleHand(DriveHand):
    """Orders step after step at 5 mm/s: only the hold keeps the needle from moving.

    Attributes
    ----------
    moves : list of Moved
        What was heard of motion.
    insertion : float
        Where the axis is [m].
    """

    def __init__(self) -> None:
        super().__init__()
        self.moves: list[Moved] = []
        self.insertion = 0.0
        self._ordered: int | None = None
        self._ordered_at = 0.0
        self.now_ns = lambda: self.joint_stamps[-1]
        # sim_rig's time starts when somebody hears its tips and is its controller.
        self._controller = self.create_publisher(
            DiagnosticStatus, "needle/controller_status", LATCHED
        )
        self.create_subscription(PointStamped, "needle/tip", lambda _: None, RELIABLE)
        self.create_subscription(
            PoseWithCovarianceStamped, "needle/tip_pose", lambda _: None, RELIABLE
        )
        self.create_subscription(JointState, "joint_states", self._on_motion, JOINT_STATES)
        self.create_timer(_PERIOD, self._order, clock=STEADY_CLOCK)

    def prepare(self) -> None:
        """Home and enable."""
        self.home()
        self.insist("enable", True)
        self.until(lambda: self.status.get("state") == "HOLDING", "enabled")

    def _on_motion(self, message: JointState, information: dict[str, Any]) -> None:
        insertion = dict(zip(message.name, message.position, strict=True))[JOINTS[0]]
        if insertion != self.insertion:
            self.insertion = insertion
            self.moves.append(Moved(information["source_timestamp"], insertion))

    def _order(self) -> None:
        if self.status.get("state") != "HOLDING" or not self.joint_stamps:
            return
        if self._ordered not in self.results and time.monotonic() - self._ordered_at < _AGAIN:
            return
        self._ordered = self.command(self.insertion + _STEP, 0.0, _STEP / SPEED)
        self._ordered_at = time.monotonic()
