"""Prepares a simulated rig, and sees when its needle moved last."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.client import Client
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from campaign.trials.listening_node import ListeningNode
from needle_core.errors import UserError
from needle_core.ros.conversions import JOINT_STATES, LATCHED, values_of

_INSERTION = "insertion_joint"
# What counts as motion: less than any set-point, more than rounding [m].
_STILL = 1e-9


@dataclasses.dataclass(frozen=True)
class Place:
    """Place of the needle at a time.

    Attributes
    ----------
    time : float
        When the rig said it, on the system clock [s].
    insertion : float
        [m].
    """

    time: float
    insertion: float


class HoldWitness(ListeningNode):
    """Hears the joints and the statuses; calls what prepares a rig.

    Parameters
    ----------
    places_from : str, optional
        Topic (sensor_msgs/JointState) that says where the needle is.
    """

    def __init__(self, places_from: str = "joint_states") -> None:
        super().__init__("hold_witness")
        self.places: list[Place] = []
        self.device: dict[str, str] = {}
        self.controller: dict[str, str] = {}
        self.create_subscription(JointState, places_from, self._on_joints, JOINT_STATES)
        self.create_subscription(
            DiagnosticStatus,
            "device/status",
            lambda message: self.device.update(values_of(message)),
            LATCHED,
        )
        self.create_subscription(
            DiagnosticStatus,
            "needle/controller_status",
            lambda message: self.controller.update(values_of(message)),
            LATCHED,
        )
        self._callable: dict[str, Client[Any, Any]] = {
            name: self.create_client(kind, name)
            for name, kind in (
                ("device/confirm_needle_out", SetBool),
                ("device/home", Trigger),
                ("device/enable", SetBool),
                ("plane_controller/start", Trigger),
            )
        }

    def state_now(self) -> str:
        """Return what the rig said last."""
        return f"; device: {self.device}, controller: {self.controller.get('state')}"

    def prepare(self, patience: float) -> None:
        """Home and enable the rig, and start its controller.

        Raises
        ------
        UserError
            If it is not ready within `patience` [s] each.
        """
        for client in self._callable.values():
            self.until(client.service_is_ready, f"service {client.srv_name}", patience)
        self._insist("device/confirm_needle_out", SetBool.Request(data=True))
        self._insist("device/home", Trigger.Request())
        self.until(
            lambda: self.device.get("homed") == "true" and self.device.get("state") == "DISABLED",
            "homed",
        )
        self._insist("device/enable", SetBool.Request(data=True))
        self._insist("plane_controller/start", Trigger.Request())

    @property
    def insertion(self) -> float:
        """The needle's insertion now [m]."""
        return self.places[-1].insertion if self.places else 0.0

    def last_motion(self, begin: float, end: float) -> float:
        """Return when the needle moved last of a time [s]; its beginning where it did not."""
        return max((at.time for at, _ in self._motions(begin, end)), default=begin)

    def way(self, begin: float, end: float) -> float:
        """Return how far the needle moved in a time, to and fro [m]."""
        return sum(way for _, way in self._motions(begin, end))

    def longest_silence(self, begin: float, end: float) -> float:
        """Return the longest that the rig said nothing in a time [s]: it stood still itself."""
        told = [at.time for at in self.places if begin < at.time <= end]
        return max((after - before for before, after in itertools.pairwise(told)), default=0.0)

    def _motions(self, begin: float, end: float) -> Iterator[tuple[Place, float]]:
        """Yield each place of a time that is another than that before, and how far from it."""
        for before, after in itertools.pairwise(self.places):
            way = abs(after.insertion - before.insertion)
            if begin < after.time <= end and way > _STILL:
                yield after, way

    def _insist(self, name: str, request: Any) -> None:
        for _ in range(100):
            answer = self.answer_to(self._callable[name], request)
            if answer.success:
                return
            self.pause(0.1)
        raise UserError(f"{name} is refused: {answer.message}")

    def _on_joints(self, message: JointState, info: dict[str, int]) -> None:
        at = dict(zip(message.name, message.position, strict=True))
        self.places.append(Place(info["source_timestamp"] * 1e-9, at[_INSERTION]))
